"""Sampled town for SUMO: a plan with lanes, parking bays, bends and hills."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np
import shapely
from pydantic import Field

from torchcover.files import parse_xml
from torchcover.geometry.arrays import Float64
from torchcover.simulation.documents import Document
from torchcover.simulation.sumo.simulating import run_program
from torchcover.simulation.traffic.hills import Hills
from torchcover.simulation.traffic.kind import PeoplePerKm, VehiclesPerKm

NetworkLayout = Literal["rand", "grid", "spider"]
StreetEnds = tuple[str, str]  # names of the nodes at both ends of a street, in alphabetical order


@dataclass(frozen=True)
class TownParams:
    """Dimensions of streets.

    Args:
        lane_m: Width of lanes.
        bicycle_lane_m: Width of bicycle lanes.
        bay_m: Width of parking bays.
        sidewalk_m: Smallest and largest width of sidewalks.
        median_m: Smallest and largest width of half of a median.
        bay_share: Share of the street sides with parking bays.
        bicycle_lane_share: Share of the street sides with bicycle lanes.
        median_share: Share of the street sides with a median.
        min_clearance_m: Smallest distance between the centerlines of two streets that do not meet.
        num_segments: Number of straight segments of a bend.
        corner_radius_m: Radius of curbs at corners.
        turning_mps2: Lateral acceleration of vehicles in turns.
        curve_m: Length over which the curvature of a turn is measured; drivers round curves within it.
    """

    lane_m: float = 3.25
    bicycle_lane_m: float = 1.8
    bay_m: float = 2.3
    sidewalk_m: tuple[float, float] = (2.4, 3.4)
    median_m: tuple[float, float] = (0.8, 1.8)
    bay_share: float = 0.7
    bicycle_lane_share: float = 0.5
    median_share: float = 0.3
    min_clearance_m: float = 40.0
    num_segments: int = 10
    corner_radius_m: float = 6.0
    turning_mps2: float = 2.0
    curve_m: float = 5.0


TOWN = TownParams()


class RandomStreets(Document):
    """Streets and traffic that are sampled from a seed.

    Args:
        layout: Plan of the streets; sampled if None.
        max_lanes_per_direction: Largest number of lanes in each direction.
        speed_limit_mps: Speed limit.
        max_bend_ratio: Largest offset of the middle of a street from the straight line, as a share of its length.
        hill_height_std_m: Standard deviation of the ground height; 0 is a plane.
        traffic_per_km: Vehicles per kilometer of lane.
        buses_per_km: Buses per kilometer of lane, in addition.
        cyclists_per_km: Cyclists per kilometer of lane that they may use.
        people_per_km: Pedestrians per kilometer of sidewalk.
    """

    layout: NetworkLayout | None = None
    max_lanes_per_direction: Annotated[int, Field(ge=1, le=3)] = 2
    speed_limit_mps: Annotated[float, Field(ge=5.0, le=35.0)] = 13.9
    max_bend_ratio: Annotated[float, Field(ge=0.0, le=0.1)] = 0.06
    hill_height_std_m: Annotated[float, Field(ge=0.0, le=5.0)] = 0.5
    traffic_per_km: VehiclesPerKm = 14.0
    buses_per_km: VehiclesPerKm = 1.0
    cyclists_per_km: PeoplePerKm = 1.5
    people_per_km: PeoplePerKm = 16.0

    def build_network(self, folder: Path, generator: np.random.Generator) -> Path:
        """Sample a network.

        Args:
            folder: Folder of the network file.
            generator: Random generator.

        Returns:
            The network file.
        """
        layout = self.layout or str(generator.choice(["rand", "grid", "spider"]))
        prefix = folder / "plan"
        seed = str(generator.integers(1 << 31))
        options = _sample_layout_options(layout, generator)
        run_program("netgenerate", *options, "--seed", seed, "--plain-output-prefix", prefix)
        nodes_m = {}
        for node in parse_xml(prefix.with_suffix(".nod.xml")).iter("node"):
            nodes_m[node.get("id", "")] = (float(node.get("x", "")), float(node.get("y", "")))
        edges = list(parse_xml(prefix.with_suffix(".edg.xml")).iter("edge"))
        hills = Hills(self.hill_height_std_m, generator)
        node_file, edge_file, network_file = folder / "nodes.xml", folder / "edges.xml", folder / "sampled.net.xml"
        edge_file.write_text(self._format_edges(nodes_m, edges, hills, generator), encoding="utf-8")
        node_file.write_text(_format_nodes(nodes_m, hills), encoding="utf-8")
        run_program(
            "netconvert", "--node-files", node_file, "--edge-files", edge_file, "--output-file", network_file,
            "--precision", "3", "--tls.guess", "--walkingareas", "--crossings.guess",
            "--no-turnarounds.except-deadend",
            "--default.junctions.radius", str(TOWN.corner_radius_m), "--junctions.internal-link-detail", "12",
        )  # fmt: skip
        network = parse_xml(network_file)
        # netconvert computes the speed of a turn from its average curvature.
        for lane in network.iterfind("edge[@function='internal']/lane"):
            line_m = np.array([text.split(",")[:2] for text in lane.get("shape", "").split()], dtype=np.float64)
            lane.set("speed", f"{min(self.speed_limit_mps, compute_turning_speed_mps(line_m)):.2f}")
        ElementTree.ElementTree(network).write(network_file)
        return network_file

    def _format_edges(
        self,
        nodes_m: Mapping[str, tuple[float, float]],
        edges: Sequence[ElementTree.Element],
        hills: Hills,
        generator: np.random.Generator,
    ) -> str:
        """Format the edges of bent streets for netconvert."""
        # Both directions of a street have the same centerline.
        edges_by_street: dict[StreetEnds, list[tuple[str, str, str]]] = {}
        for edge in edges:
            name, start, end = edge.get("id", ""), edge.get("from", ""), edge.get("to", "")
            edges_by_street.setdefault((min(start, end), max(start, end)), []).append((name, start, end))
        lines: dict[StreetEnds, shapely.LineString] = {}
        # The plan of netgenerate knows no widths: streets that come too close to earlier ones are left out.
        for ends in edges_by_street:
            start_m, end_m = np.array(nodes_m[ends[0]]), np.array(nodes_m[ends[1]])
            line = shapely.LineString(self._sample_bend(start_m, end_m, generator))
            is_clear = True
            for other_ends, other_line in lines.items():
                meets = set(ends) & set(other_ends)
                is_clear &= bool(meets or line.distance(other_line) >= TOWN.min_clearance_m)
            if is_clear:
                lines[ends] = line
        # Junctions are level: all streets are level at their ends.
        shares = np.linspace(0.0, 1.0, TOWN.num_segments + 1)
        rows = []
        for ends in remove_dead_ends(list(lines)):
            line_m, lanes = shapely.get_coordinates(lines[ends]), self._sample_lanes(generator)
            start_height_m, end_height_m = hills.compute_heights_m(line_m[[0, -1]])
            heights_m = start_height_m + (end_height_m - start_height_m) * shares**2 * (3 - 2 * shares)
            positions = [f"{x:.3f},{y:.3f},{z:.3f}" for (x, y), z in zip(line_m, heights_m, strict=True)]
            for name, start, end in edges_by_street[ends]:
                shape = " ".join(positions if start == ends[0] else positions[::-1])
                rows.append(
                    f"<edge id={quoteattr(name)} from={quoteattr(start)} to={quoteattr(end)} "
                    f'numLanes="{lanes.count("<lane")}" speed="{self.speed_limit_mps:.2f}" shape="{shape}">{lanes}'
                    "</edge>"
                )
        return f"<edges>{''.join(rows)}</edges>"

    def _sample_bend(self, start_m: Float64, end_m: Float64, generator: np.random.Generator) -> Float64:
        """Sample a line (K, 2) that leaves both ends straight."""
        shares = np.linspace(0.0, 1.0, TOWN.num_segments + 1)[:, None]
        along_m = end_m - start_m
        bend_ratio = generator.uniform(-self.max_bend_ratio, self.max_bend_ratio)
        offsets = bend_ratio * np.sin(np.pi * shares) ** 2
        return np.asarray(start_m + shares * along_m + offsets * np.array([-along_m[1], along_m[0]]))

    def _sample_lanes(self, generator: np.random.Generator) -> str:
        """Sample the lanes of one side of a street, from the houses inwards."""
        lanes = [('allow="pedestrian"', generator.uniform(*TOWN.sidewalk_m))]
        if generator.random() < TOWN.bay_share:
            lanes.append(('type="parking" disallow="all"', TOWN.bay_m))
        if self.cyclists_per_km > 0 and generator.random() < TOWN.bicycle_lane_share:
            lanes.append(('allow="bicycle"', TOWN.bicycle_lane_m))
        num_lanes = int(generator.integers(1, self.max_lanes_per_direction + 1))
        lanes += [('disallow="pedestrian"', TOWN.lane_m)] * num_lanes
        if generator.random() < TOWN.median_share:
            lanes.append(('type="median" disallow="all"', generator.uniform(*TOWN.median_m)))
        rows = []
        for index, (attributes, width_m) in enumerate(lanes):
            rows.append(f'<lane index="{index}" {attributes} width="{width_m:.2f}"/>')
        return "".join(rows)


def _format_nodes(nodes_m: Mapping[str, tuple[float, float]], hills: Hills) -> str:
    """Format the nodes with their heights for netconvert."""
    heights_m = hills.compute_heights_m(np.array(list(nodes_m.values())))
    rows = []
    for (name, (x, y)), z in zip(nodes_m.items(), heights_m, strict=True):
        rows.append(f'<node id={quoteattr(name)} x="{x:.3f}" y="{y:.3f}" z="{z:.3f}"/>')
    return f"<nodes>{''.join(rows)}</nodes>"


def compute_turning_speed_mps(line_m: Float64) -> float:
    """Compute the speed at which a turn can be driven, from its tightest part.

    Args:
        line_m: (K, 2) centerline.
    """
    steps_m = np.diff(line_m, axis=0)
    lengths_m = np.hypot(*steps_m.T)
    headings_rad = np.unwrap(np.arctan2(steps_m[:, 1], steps_m[:, 0]))
    middles_m = np.cumsum(lengths_m) - lengths_m / 2
    turns_rad = np.abs(np.interp(middles_m + TOWN.curve_m, middles_m, headings_rad) - headings_rad)
    return float(np.sqrt(TOWN.turning_mps2 * TOWN.curve_m / max(turns_rad.max(), 1e-6)))


def remove_dead_ends(streets: list[StreetEnds]) -> list[StreetEnds]:
    """Remove streets that do not continue at both ends, repeatedly.

    Args:
        streets: Ends of the streets.

    Returns:
        The remaining streets; all of them if none would remain.
    """
    remaining = streets
    while True:
        counts: Counter[str] = Counter()
        for ends in remaining:
            counts.update(ends)
        continuing = [ends for ends in remaining if counts[ends[0]] > 1 and counts[ends[1]] > 1]
        if len(continuing) == len(remaining):
            return remaining or streets
        remaining = continuing


def _sample_layout_options(layout: str, generator: np.random.Generator) -> list[str]:
    """Sample the options of netgenerate for a layout."""
    if layout == "rand":
        return ["--rand", "--rand.iterations", "45", "--rand.min-distance", "90", "--rand.max-distance", "200"]
    if layout == "grid":
        x_m, y_m = generator.uniform(90, 150), generator.uniform(90, 150)
        return ["--grid", "--grid.number", "5", "--grid.x-length", f"{x_m:.1f}", "--grid.y-length", f"{y_m:.1f}"]
    num_arms, radius_m = generator.integers(5, 8), generator.uniform(100, 140)
    options = ["--spider", "--spider.arm-number", str(num_arms), "--spider.circle-number", "3"]
    return [*options, "--spider.space-radius", f"{radius_m:.1f}", "--spider.omit-center"]
