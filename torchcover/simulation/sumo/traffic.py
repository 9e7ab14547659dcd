"""Traffic of type `sumo`: road networks and road users of SUMO, given or sampled."""

import warnings
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Literal, Self

import numpy as np
import shapely
from pydantic import Field, model_validator

from torchcover.files import BadFileError
from torchcover.geometry.arrays import Bools, Float64
from torchcover.recordings.unsupported_formats import find_remedy
from torchcover.simulation.documents import RelativePath
from torchcover.simulation.sumo.crowd import drop_colliding_users, read_vehicle_types, select_road_users
from torchcover.simulation.sumo.floating import (
    FloatingCarData,
    TimeWindow,
    parse_floating_car_data,
    read_floating_car_data,
)
from torchcover.simulation.sumo.ground import BodyPlacer, Sidewalks, build_bridges, build_ground, place_parked_vehicles
from torchcover.simulation.sumo.motion import Motion, RoadUser, compute_motions
from torchcover.simulation.sumo.network import SAME_POSITION_M, read_network
from torchcover.simulation.sumo.routes import EGO_TYPE, write_routes
from torchcover.simulation.sumo.simulating import convert_opendrive, find_sumo_home, simulate
from torchcover.simulation.sumo.streets import RandomStreets
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.fleet import EGO, Fleet
from torchcover.simulation.traffic.frontage import RoadsideDensity, StreetSide, find_street_sides, place_scenery
from torchcover.simulation.traffic.kind import ProceduralTraffic, SceneParts
from torchcover.simulation.traffic.scenery import Scenery, merge_by_kind

# Sampled traffic starts everywhere at once and needs this time to move and to queue at traffic lights.
WARM_UP_S = 30.0


def find_visible_sides(
    vicinity: Vicinity, built_share: float, generator: np.random.Generator
) -> tuple[list[StreetSide], list[shapely.Geometry]]:
    """Find the visible sides of streets, and the areas without roadside objects.

    Args:
        vicinity: Part of a network.
        built_share: Share of the sides with houses.
        generator: Random generator.
    """
    curb_offset_m, facade_offset_m = 1.0, 2.2  # so that no crown of a tree is over a lane
    clearance_m = 0.4  # distance of all objects from lanes
    gap_m = 1.0  # gaps that networks leave between lanes
    bridge_margin_m = 12.0  # no objects stand next to bridges
    streets = shapely.buffer(vicinity.street_polygons, gap_m, join_style="mitre")
    street_area = shapely.union_all(streets).buffer(-gap_m)
    bridges = vicinity.build_bridge_area(bridge_margin_m)
    shapely.prepare(bridges)

    def is_visible(positions_m: Float64) -> Bools:
        """Test which positions (N, 2) are visible and not next to a bridge."""
        return np.asarray(vicinity.is_visible(positions_m) & ~shapely.contains_xy(bridges, *positions_m.T))

    offsets_m = (curb_offset_m, facade_offset_m)
    sides = find_street_sides(street_area, offsets_m, is_visible, built_share, generator)
    return sides, shapely.buffer(vicinity.street_polygons, clearance_m).tolist()


class SumoTraffic(ProceduralTraffic):
    """Traffic of SUMO on a given network, or on a network that is sampled for each run.

    Args:
        net: Road network: `.net.xml`, or `.xodr` (OpenDRIVE); relative to the document.
        omit_missing_links: Whether links of an `.xodr` to missing roads and junctions are removed.
        routes: Files of routes on the network, which SUMO simulates.
        fcd: Floating car data that SUMO wrote, instead of a simulation.
        random: Sampled streets and traffic; with a network, sampled traffic only.
        ego_id: Name of the ego vehicle; if None, a vehicle that is present all the time is sampled for each run.
        ego_type: Name of the type from which it is sampled; any car if None.
        begin_s: Time of the simulation at which the run begins, at the earliest, since the ego vehicle must be present.
            If None: 60 s, or the start of the floating car data.
        built_share: Share of the sides of streets with houses.
        roadside_density: Factor on the usual density of roadside objects other than houses, or factors for some kinds,
            such as `{hedge: 2, lamp: 0}`.
        parked_share: Share of the parking bays (lanes of type "parking") that are occupied.
    """

    type: Literal["sumo"] = "sumo"
    net: RelativePath | None = None
    omit_missing_links: bool = False
    routes: tuple[RelativePath, ...] = ()
    fcd: RelativePath | None = None
    random: RandomStreets | None = None
    ego_id: str | None = None
    ego_type: str | None = None
    begin_s: Annotated[float, Field(ge=0.0)] | None = None
    built_share: float = Field(default=0.8, ge=0.0, le=1.0)
    roadside_density: RoadsideDensity = 1.0
    parked_share: float = Field(default=0.75, ge=0.0, le=1.0)

    @model_validator(mode="after")
    def _check_sources(self) -> Self:
        """Check that network and traffic are given once, or sampled."""
        if self.random is None:
            if self.net is None or not (self.routes or self.fcd):
                raise ValueError("give a net and its routes, a net and its fcd, or random (which may have a net, too)")
            return self
        conflicting = [key for key in ("routes", "fcd", "ego_id", "ego_type", "begin_s") if getattr(self, key)]
        if conflicting:
            raise ValueError(f"random samples all traffic; leave out {', '.join(conflicting)}, or random")
        street_keys = {"layout", "max_lanes_per_direction", "speed_limit_mps", "max_bend_ratio", "hill_height_std_m"}
        unused = sorted(street_keys & self.random.model_fields_set)
        if self.net is not None and unused:
            raise ValueError(f"random: {', '.join(unused)} only apply to sampled streets; remove them, or net")
        return self

    def check(self) -> None:
        """Check that SUMO is installed if it is needed.

        Raises:
            ImportError: SUMO is missing.
        """
        if self.fcd is None or (self.net is not None and self.net.suffix == ".xodr"):
            find_sumo_home()

    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        """Build static scenery, ego vehicle and actors."""
        duration_s = float(times_s[-1])
        vicinity, ego, users, origin_m = self._select_road_users(fleet, duration_s, generator)
        ground = build_ground(vicinity)
        sidewalks = Sidewalks(vicinity, ground)
        sides, clear_areas = find_visible_sides(vicinity, self.built_share, generator)
        roadside = place_scenery(
            sides, clear_areas, clear_areas, (), ground.compute_heights_m, self.roadside_density, generator
        )
        raised = merge_by_kind(sidewalks.build_meshes(), build_bridges(vicinity))
        static_meshes = (ground.build_mesh(), *raised, *merge_by_kind(*roadside))
        parked = place_parked_vehicles(vicinity, ground, fleet, self.parked_share, generator)
        # Near the centerline of a lane on a bridge, an obstacle may be below the bridge.
        bridge_area = vicinity.build_bridge_area(3.0)
        obstacles = shapely.difference(np.concatenate([sidewalks.polygons, parked]), bridge_area)
        motions = compute_motions([ego, *users], duration_s, origin_m, obstacles, sidewalks.walkable_area)
        remaining = drop_colliding_users(motions)
        fleet.omitted_count = len(motions) - len(remaining)
        self._warn_of_omissions(motions, remaining, len(users))
        placer = BodyPlacer(ground, sidewalks)
        ego_actor = placer.build_ego(remaining[0], times_s, fleet.meshes[EGO], generator)
        scenery = Scenery(static_meshes, tuple(range(1 + len(raised))))
        return scenery, ego_actor, placer.build_actors(remaining[1:], fleet, duration_s)

    def _select_road_users(
        self, fleet: Fleet, duration_s: float, generator: np.random.Generator
    ) -> tuple[Vicinity, RoadUser, list[RoadUser], Float64]:
        """Select the part of the network, the ego vehicle, road users near it, and the origin (2,) of the scene."""
        with TemporaryDirectory() as folder:
            network_file = self._find_network_file(Path(folder), generator)
            network = read_network(network_file)
            routes = self.routes
            if self.random is not None:
                routes = (Path(folder) / "sampled.rou.xml",)
                write_routes(*routes, network, self.random, fleet, WARM_UP_S + duration_s, generator)
            vehicle_types = {}
            for path in routes:
                vehicle_types.update(read_vehicle_types(path))
            data = self._load_floating_car_data(network_file, routes, duration_s, generator)
        ego_type = EGO_TYPE if self.random is not None else self.ego_type
        ego, users = select_road_users(data, vehicle_types, fleet, self.ego_id, ego_type, duration_s, generator)
        # The origin has integer coordinates near the first position of the ego vehicle.
        track_origin_m = np.floor(ego.track.front_positions_m[0, :2])
        (ego_motion,) = compute_motions([ego], duration_s, track_origin_m)
        start_m = np.floor(ego_motion.poses[0, :2] + SAME_POSITION_M)
        origin_m, path_m = track_origin_m + start_m, ego_motion.poses[:, :2] - start_m
        vicinity = Vicinity(network, path_m, origin_m)
        off_street = np.flatnonzero(~vicinity.is_on_street(path_m))
        if len(off_street):
            time_s = data.begin_s + ego_motion.times_s[off_street[0]]
            raise ValueError(
                f"the ego vehicle is farther than {vicinity.params.max_off_street_m:g} m from all streets of the "
                f"network at t = {time_s:g} s: it leaves them, or the data belong to another network"
            )
        return vicinity, ego, users, origin_m

    def _warn_of_omissions(self, motions: Sequence[Motion], remaining: Sequence[Motion], num_users: int) -> None:
        """Warn of omitted road users; of sampled traffic, some may be missing."""
        # Sampled traffic is only a density, of which a few road users may be missing.
        max_omitted_share = 0.0 if self.random is None else 0.15
        num_omitted = len(motions) - len(remaining)
        if num_omitted > max_omitted_share * num_users:
            remaining_names = {motion.road_user.track.name for motion in remaining}
            missing = sorted({motion.road_user.track.name for motion in motions} - remaining_names)
            warnings.warn(
                f"{num_omitted} of {num_users} road users of the simulation are left out: they overlap others or "
                f"curbs, or are faster than people can be ({', '.join(repr(name) for name in missing[:3])})",
                stacklevel=3,
            )

    def _find_network_file(self, folder: Path, generator: np.random.Generator) -> Path:
        """Find the network in SUMO's format; sampled and converted networks are written into a folder."""
        if self.net is None:
            assert self.random is not None  # checked in _check_sources
            return self.random.build_network(folder, generator)
        if self.net.suffix == ".xodr":
            return convert_opendrive(self.net, folder, omit_missing_links=self.omit_missing_links)
        if self.net.suffix != ".xml" and (remedy := find_remedy(self.net)):
            raise BadFileError(f"{self.net}: a network is a .net.xml or .xodr file; {remedy}")
        return self.net

    def _load_floating_car_data(
        self, network_file: Path, routes: tuple[Path, ...], duration_s: float, generator: np.random.Generator
    ) -> FloatingCarData:
        """Read floating car data, or simulate."""
        if self.fcd is not None:
            return read_floating_car_data(self.fcd, TimeWindow(self.begin_s or -np.inf, duration_s, self.ego_id))
        is_sampled = self.random is not None
        begin_s = 60.0 if self.begin_s is None else self.begin_s
        begin_s = WARM_UP_S if is_sampled else begin_s
        seed = int(generator.integers(1 << 31))
        chunks = simulate(network_file, routes, begin_s, seed, around_vehicle=self.ego_id, is_sampled=is_sampled)
        data = parse_floating_car_data(chunks, TimeWindow(begin_s, duration_s, self.ego_id))
        if not np.isfinite(data.last_time_s):
            raise ValueError(
                f"the simulation ends before t = {begin_s:g} s, where the run begins: all vehicles have arrived, or "
                "none departs; change begin_s, or the routes"
            )
        return data
