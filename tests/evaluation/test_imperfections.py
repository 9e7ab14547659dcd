"""No imperfection makes a rig better: what is measured worse, or not at all, covers no more."""

from dataclasses import replace
from itertools import pairwise

import pytest

from tests.simulation.small_worlds import FLOOR, box, scenario
from torchcover import BevGrid, CoverageMetric, Region
from torchcover.contrib import PUBLISHED, Setup, Sights, SMig
from torchcover.coverage import Maximum
from torchcover.data import SimulatedFrames
from torchcover.evaluation.observers import CoverageObserver
from torchcover.placement import CommonFrames, Objective
from torchcover.simulation import Rig, SurfaceReference
from torchcover.targets import Raster, Target, survey

AREA = Region("20m", (2.0, 22.0), (-6.0, 6.0))
GRID = BevGrid(
    x=AREA.x, y=AREA.y, cell=0.5, heights={"ground": (-0.5, 0.2), "obstacle": (0.2, 2.0)}, band_frame="ground"
)
CAR = {"category": "car", "shape": {"type": "box", "size_m": [4, 1.8, 1.5]}}
CARS = [{"name": f"car {x_m}", "pose": {"x_m": x_m, "y_m": y_m}, **CAR} for x_m, y_m in ((9, -3), (17, 2))]
WORLD = scenario(FLOOR, box([0.5, 12, 4], x_m=21.0), actors=CARS)
RIG = {
    "lidar": {"channels": 24, "vertical_fov_deg": [-25, 5], "horizontal_fov_deg": 120, "columns": 240},
    "camera": {"width": 120, "height": 60, "fov_deg": 100},
    "radar": {"horizontal_fov_deg": 120, "vertical_fov_deg": [-20, 8], "azimuth_cell_deg": 3, "range_cell_m": 0.5},
}
# Each worse than the one before.
CHAINS = {
    "range noise": [{"range_noise_m": sigma} for sigma in (0.0, 0.03, 0.2, 0.5, 3.0)],
    "drop-out": [{"dropout": share} for share in (0.0, 0.2, 0.7, 1.0)],
    "missing returns": [{}, *({"range_at_10_percent_m": range_m} for range_m in (200.0, 30.0, 8.0))],
    "share of the range": [{"range_noise_share": share} for share in (0.0, 0.002, 0.02, 0.1)],
    "stereo": [{}, *({"stereo": {"baseline_m": b_m, "subpixel_px": 0.3}} for b_m in (0.5, 0.1, 0.03))],
    "both": [{}, {"range_noise_m": 0.3, "dropout": 0.3}, {"range_noise_m": 1.0, "dropout": 0.5}],
}
ONLY = {"share of the range": "camera", "stereo": "camera", "missing returns": "lidar"}
WEATHERS = [
    {},
    {"visibility_m": 200.0},
    {"visibility_m": 60.0},
    {"visibility_m": 60.0, "rain_mm_h": 30.0, "road": "wet"},
]
# Those that more is better of, or less. How evenly points lie, and s_mig_occluded, rise by their formulas, as the page
# of metrics says; false_visible is a share of what is invisible, which grows; the others read no points of a rig.
PUBLISHED_WITH_LAW = ("object_coverage", "perception_entropy", "k_cover", "point_density")
NO_VIRTUE = "point_uniformity"


def rig(kind, name, **changes):
    keys = {"type": kind, "mount": {"x_m": 1.8, "z_m": 1.6}, "max_range_m": 40, **RIG[kind], **changes}
    others = [{**keys, "name": "left"}, {**keys, "name": "right", "mount": {"x_m": 2.2, "y_m": -0.8, "z_m": 1.2}}]
    return Rig.model_validate({"name": name, "sensors": others})


def numbers_of(rigs, steps=1, world=WORLD):
    """Name of each rig -> all its numbers."""
    reference = SurfaceReference(((AREA.x, AREA.y),), rays=1000, bands_m=((-0.5, 2.0),), object_points=32)
    frames = SimulatedFrames(world, rigs=rigs, steps=steps, reference_sensor=reference, boxes=True)
    observers = {}
    for name, one in rigs.items():
        sensors = [sensor.name for sensor in one.sensors]
        metric = CoverageMetric(
            GRID, (0.2, 0.4, 3.0), max_radius=30.0, aggregations=(Maximum(),), regions=(AREA,), sensors=sensors,
            square_metres=True,
        )  # fmt: skip
        setup = Setup(name, one.sensors, None, GRID, (AREA,), threshold_m=0.4, sights=Sights())
        observers[name] = [
            CoverageObserver(metric, name),
            *(PUBLISHED[other].make(setup) for other in PUBLISHED_WITH_LAW),
        ]
    for frame in frames:
        for one in (one for of_rig in observers.values() for one in of_rig):
            one.update(frame)
    found = {}
    for name, (coverage, *others) in observers.items():
        own = {}
        for row in coverage.compute().summary():
            kinds = {"": row.numbers, "known": row.known, "seen by": row.redundancy.seen_by, **row.redundancy.without}
            own |= {(row.region, row.height, kind, key): one for kind, of in kinds.items() for key, one in of.items()}
        found[name] = own | {number.quantity.key: number for other in others for number in other.compute()}
    return found


def never_better(found):
    """Of the numbers of rigs or worlds, each worse than the one before."""
    for better, worse in pairwise(found):
        for key, number in better.items():
            if str(key).startswith(NO_VIRTUE) or number.value != number.value:
                continue
            gain = (worse[key].value - number.value) * (-1 if number.quantity.lower_is_better else 1)
            assert not gain > 1e-9, (key, number.value, worse[key].value)
    first, *_, last = (one["20m", "ground", "", "detection_0.4m"].value for one in found)
    assert first > last + 0.05


@pytest.mark.parametrize(
    ("kind", "chain"),
    [(kind, chain) for kind in RIG for chain in CHAINS if ONLY.get(chain, kind) == kind],
)
def test_no_imperfection_makes_a_rig_better(kind, chain):
    rigs = {str(at): rig(kind, str(at), **keys) for at, keys in enumerate(CHAINS[chain])}
    never_better(list(numbers_of(rigs).values()))


def test_no_weather_makes_a_rig_better():
    sensor, keys = rig("lidar", "r", range_at_10_percent_m=40.0), WORLD.model_dump(exclude_unset=True)
    worlds = [type(WORLD).model_validate({**keys, "weather": weather}) for weather in WEATHERS]
    never_better([numbers_of({"r": sensor}, world=world)["r"] for world in worlds])


def test_what_s_mig_captures_falls_with_what_returns():
    """The number itself rises: by the published sign, less that is crossed is better."""
    rigs = {str(at): rig("lidar", str(at), **keys) for at, keys in enumerate(CHAINS["missing returns"])}
    frame, captured = SimulatedFrames(WORLD, rigs=rigs, steps=1, boxes=True)[0], []
    for name, one in rigs.items():
        metric = SMig(one.sensors, 1.0, categories=("car",), occlusion=True, rig=name)
        metric.update([frame, replace(frame, boxes=frame.boxes.of_category())])  # the cars are there every other time
        captured.append(metric.compute()[0].parameters["entropy_captured_nats"])
    assert captured == sorted(captured, reverse=True)
    assert captured[-1] < captured[0]


@pytest.mark.parametrize("kind", RIG)
def test_what_does_not_err_is_what_it_was(kind):
    """One that errs by less than float32 resolves covers what an exact one does."""
    exact, nearly = numbers_of(
        {"exact": rig(kind, "exact"), "nearly": rig(kind, "nearly", range_noise_m=1e-9)}
    ).values()
    assert {key: one.value for key, one in exact.items()} == pytest.approx(
        {key: one.value for key, one in nearly.items()}, rel=0, abs=0, nan_ok=True
    )


@pytest.mark.parametrize("number", ["detection_0.2m", "radius_m", "seen_by_two_0.4m", "detection_0.4m_without_any"])
def test_no_imperfection_lets_a_search_prefer_a_rig(number):
    instants = CommonFrames([WORLD], {"asked": Objective(number=number, region="20m", band="ground")}, rays=1024)
    for chain in ("range noise", "drop-out", "missing returns"):
        rigs = [rig("lidar", "r", **keys) for keys in CHAINS[chain]]
        found = [float(instants.score(one).estimate.value[0]) for one in rigs]
        found = [-value for value in found] if number == "radius_m" else found
        assert found == sorted(found, reverse=True)
        assert found[-1] < found[0]


@pytest.mark.parametrize(
    ("kind", "chain"), [("lidar", "missing returns"), ("camera", "stereo"), *((kind, "both") for kind in RIG)]
)
def test_a_target_gets_no_more_points_from_a_sensor_that_errs(kind, chain):
    raster = Raster((4.0, 12.0), (-2.0, 2.0), 4.0)
    found = [survey(rig(kind, "r", **keys), WORLD, Target.load("adult"), raster) for keys in CHAINS[chain]]
    for exact, erring in pairwise(found):
        assert (erring.points <= exact.points).all()
        assert not (erring.share > exact.share).any()
    assert found[-1].points.sum() < found[0].points.sum()
