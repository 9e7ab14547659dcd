"""Traffic of type `sumo`: road networks and road users of SUMO, the user's own or drawn."""

import warnings
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
from torchcover.simulation.sumo.crowd import read_vehicle_types, select_road_users
from torchcover.simulation.sumo.floating import (
    FloatingCarData,
    TimeWindow,
    parse_floating_car_data,
    read_floating_car_data,
)
from torchcover.simulation.sumo.ground import BodyPlacer, Sidewalks, build_bridges, build_ground, place_parked_vehicles
from torchcover.simulation.sumo.motion import compute_motions, drop_colliding_users
from torchcover.simulation.sumo.network import SAME_POSITION_M, read_network
from torchcover.simulation.sumo.simulating import convert_opendrive, find_sumo_home, simulate
from torchcover.simulation.sumo.streets import EGO_TYPE, RandomStreets, write_routes
from torchcover.simulation.sumo.vicinity import Vicinity
from torchcover.simulation.traffic.fleet import EGO, Fleet
from torchcover.simulation.traffic.frontage import RoadsideDensity, StreetSide, find_street_sides, place_scenery
from torchcover.simulation.traffic.kind import ProceduralTraffic, SceneParts
from torchcover.simulation.traffic.scenery import Scenery, merge_by_kind

# Nothing stands nearer to a lane than this; furniture and houses keep off by more, so that no crown hangs over it.
CLEAR_M, KERB_M, BEHIND_M = 0.4, 1.0, 2.2
# Gaps that the drawing of a network left are street, too; and beside bridges nothing stands.
GAP_M, BRIDGE_M = 1.0, 12.0
# Traffic that is drawn sets off everywhere at once, and needs some time to get into motion and to queue at lights.
WARM_UP_S = 30.0
USUAL_BEGIN_S = 60.0
# Of traffic that is drawn such a share may be where bodies cannot be: more, and it is thinner than was asked for.
USUALLY_LEFT_OUT = 0.15
# In plan, nothing is in anybody's way that is so near to the middle of a lane on a bridge: it may be below.
BELOW_M = 3.0


def find_visible_sides(
    vicinity: Vicinity, built_share: float, generator: np.random.Generator
) -> tuple[list[StreetSide], list[shapely.Geometry]]:
    """What can be seen of the sides of streets, and where nothing may stand."""
    street = shapely.union_all(shapely.buffer(vicinity.street_polygons, GAP_M, join_style="mitre")).buffer(-GAP_M)
    bridges = vicinity.build_bridge_area(BRIDGE_M)
    shapely.prepare(bridges)

    def sees(places_m: Float64) -> Bools:
        return np.asarray(vicinity.is_visible(places_m) & ~shapely.contains_xy(bridges, *places_m.T))

    taken = shapely.buffer(vicinity.street_polygons, CLEAR_M).tolist()
    return find_street_sides(street, (KERB_M, BEHIND_M), sees, built_share, generator), taken


class SumoTraffic(ProceduralTraffic):
    """Traffic of SUMO, on a network of the user's own or on one that is drawn anew for each run.

    Args:
        net: A road network: `.net.xml`, or `.xodr` (OpenDRIVE).
        omit_missing_links: Whether links of an `.xodr` to roads and junctions that are not there are left out.
        routes: Files of routes for it, which SUMO drives; relative to the document.
        fcd: Floating car data, which SUMO wrote before, instead of driving now.
        random: Streets and traffic that are drawn; with a net, its traffic only.
        ego_id: Which vehicle is the ego; if not given, one that is there all the time is drawn for each run.
        ego_type: The type of which it is drawn; any car if not given.
        begin_s: Time of the simulation at which the run begins, at the earliest: the ego has to be there. After a
            minute if not given, or with the floating car data.
        built_share: Share of the streets' sides that have houses.
        roadside_density: Factor on the usual density of roadside objects other than houses, or factors for some kinds,
            such as `{hedge: 2, lamp: 0}`.
        parked_share: Share of the parking bays (lanes that no vehicle may use) that are occupied.
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
        if self.random is None and (self.net is None or not (self.routes or self.fcd)):
            raise ValueError("give a net and its routes, a net and its fcd, or random (which may have a net, too)")
        if self.random is not None:
            given = [key for key in ("routes", "fcd", "ego_id", "ego_type", "begin_s") if getattr(self, key)]
            if given:
                raise ValueError(f"random draws all traffic; leave out {', '.join(given)}, or random")
            of_streets = sorted(
                {"layout", "max_lanes_per_direction", "speed_limit_mps", "max_bend_ratio", "hill_height_std_m"}
                & self.random.model_fields_set
            )
            if self.net is not None and of_streets:
                raise ValueError(f"random: {', '.join(of_streets)} are for streets that are drawn; there is a net")
        return self

    def check(self) -> None:
        """Refuse where SUMO is needed, but not installed."""
        if self.fcd is None or (self.net is not None and self.net.suffix == ".xodr"):
            find_sumo_home()  # or an ImportError

    def _build(self, fleet: Fleet, times_s: Float64, generator: np.random.Generator) -> SceneParts:
        with TemporaryDirectory() as folder:
            network_file = self._network_file(Path(folder), generator)
            network = read_network(network_file)
            routes = self.routes
            if self.random is not None:
                routes = (Path(folder) / "drawn.rou.xml",)
                write_routes(*routes, network, self.random, fleet, WARM_UP_S + float(times_s[-1]), generator)
            known = {name: found for path in routes for name, found in read_vehicle_types(path).items()}
            recorded = self._recorded(network_file, routes, float(times_s[-1]), generator)
        ego_type = EGO_TYPE if self.random is not None else self.ego_type
        duration_s = float(times_s[-1])
        ego, others = select_road_users(recorded, known, fleet, self.ego_id, ego_type, duration_s, generator)
        near_m = np.floor(ego.track.front_positions_m[0, :2])
        (alone,) = compute_motions([ego], duration_s, near_m)
        begin_m = np.floor(alone.poses[0, :2] + SAME_POSITION_M)
        origin_m, way_m = near_m + begin_m, alone.poses[:, :2] - begin_m
        vicinity = Vicinity(network, way_m, origin_m)
        gone = np.flatnonzero(~vicinity.is_on_street(way_m))
        if len(gone):
            raise ValueError(
                f"the ego is farther than {vicinity.params.max_off_street_m:g} m from all streets of the network at t = "
                f"{recorded.begin_s + alone.times_s[gone[0]]:g} s: it leaves them, or the data are those of another "
                "network"
            )
        ground = build_ground(vicinity)
        pavement = Sidewalks(vicinity, ground)
        sides, taken = find_visible_sides(vicinity, self.built_share, generator)
        stood = place_scenery(sides, taken, taken, (), ground.compute_heights_m, self.roadside_density, generator)
        raised = merge_by_kind(pavement.build_meshes(), build_bridges(vicinity))
        static = (ground.build_mesh(), *raised, *merge_by_kind(*stood))
        parked = place_parked_vehicles(vicinity, ground, fleet, self.parked_share, generator)
        obstacles = shapely.difference(np.concatenate([pavement.polygons, parked]), vicinity.build_bridge_area(BELOW_M))
        moved = compute_motions([ego, *others], duration_s, origin_m, obstacles, pavement.walkable_area)
        shown = drop_colliding_users(moved)
        fleet.omitted_count = len(moved) - len(shown)
        if fleet.omitted_count > (0.0 if self.random is None else USUALLY_LEFT_OUT) * len(others):
            there = {motion.road_user.track.name for motion in shown}
            missing = sorted({motion.road_user.track.name for motion in moved} - there)
            warnings.warn(
                f"the simulation has {fleet.omitted_count} of {len(others)} road users where another one is, over a kerb or "
                f"faster than people are ({', '.join(map(repr, missing[:3]))}); they are left out",
                stacklevel=2,
            )
        placing = BodyPlacer(ground, pavement)
        driver = placing.build_ego(shown[0], times_s, fleet.meshes[EGO], generator)
        scenery = Scenery(static, tuple(range(1 + len(raised))))
        return scenery, driver, placing.build_actors(shown[1:], fleet, duration_s)

    def _network_file(self, folder: Path, generator: np.random.Generator) -> Path:
        """The network in SUMO's own format."""
        if self.net is None:
            assert self.random is not None  # checked in _check_sources
            return self.random.build_network(folder, generator)
        if self.net.suffix not in (".xml", ".xodr") and (remedy := find_remedy(self.net)):
            raise BadFileError(f"{self.net}: a network is a .net.xml or .xodr file; {remedy}")
        if self.net.suffix != ".xodr":
            return self.net
        return convert_opendrive(self.net, folder, omit_missing_links=self.omit_missing_links)

    def _recorded(
        self, network_file: Path, routes: tuple[Path, ...], duration_s: float, generator: np.random.Generator
    ) -> FloatingCarData:
        if self.fcd is not None:
            return read_floating_car_data(self.fcd, TimeWindow(self.begin_s or -np.inf, duration_s, self.ego_id))
        begin_s = WARM_UP_S if self.random is not None else USUAL_BEGIN_S if self.begin_s is None else self.begin_s
        seed, drawn = int(generator.integers(1 << 31)), self.random is not None
        pieces = simulate(network_file, routes, begin_s, seed, around_vehicle=self.ego_id, is_sampled=drawn)
        recorded = parse_floating_car_data(pieces, TimeWindow(begin_s, duration_s, self.ego_id))
        if not np.isfinite(recorded.last_time_s):
            raise ValueError(
                f"the simulation is over before t = {begin_s:g} s, where the run begins: everybody has arrived, "
                "or nobody sets off; change begin_s, or the routes"
            )
        return recorded
