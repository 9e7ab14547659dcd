"""Sensor errors, drop-out, missing returns and weather never increase a coverage number."""

from dataclasses import replace
from itertools import pairwise

import pytest

from tests.simulation.small_scenarios import FLOOR, box, scenario
from torchcover import BevGrid, CoverageMetric, Region
from torchcover.contrib import PUBLISHED, FrameQueryCache, MetricSetup, SMig
from torchcover.coverage import Maximum
from torchcover.data import SimulatedFrames
from torchcover.evaluation.observers import CoverageObserver
from torchcover.placement import CommonFrames, Objective
from torchcover.simulation import Rig, SurfaceReference
from torchcover.targets import Raster, Target, measure_target_visibility

AREA = Region("20m", (2.0, 22.0), (-6.0, 6.0))
GRID = BevGrid(
    x_m=AREA.x_m, y_m=AREA.y_m, cell_m=0.5, heights={"ground": (-0.5, 0.2), "obstacle": (0.2, 2.0)}, band_frame="ground"
)
CAR = {"category": "car", "shape": {"type": "box", "size_m": [4, 1.8, 1.5]}}
CARS = [{"name": f"car {x_m}", "pose": {"x_m": x_m, "y_m": y_m}, **CAR} for x_m, y_m in ((9, -3), (17, 2))]
SCENARIO = scenario(FLOOR, box([0.5, 12, 4], x_m=21.0), actors=CARS)
RIG = {
    "lidar": {"channels": 24, "vertical_fov_deg": [-25, 5], "horizontal_fov_deg": 120, "columns": 240},
    "camera": {"width": 120, "height": 60, "fov_deg": 100},
    "radar": {"horizontal_fov_deg": 120, "vertical_fov_deg": [-20, 8], "azimuth_cell_deg": 3, "range_cell_m": 0.5},
}
# Settings of a sensor, in each chain from better to worse.
CHAINS = {
    "range noise": [{"range_noise_m": sigma} for sigma in (0.0, 0.03, 0.2, 0.5, 3.0)],
    "drop-out": [{"dropout": share} for share in (0.0, 0.2, 0.7, 1.0)],
    "missing returns": [{}, *({"range_at_10_percent_m": range_m} for range_m in (200.0, 30.0, 8.0))],
    "share of the range": [{"range_noise_share": share} for share in (0.0, 0.002, 0.02, 0.1)],
    "stereo": [{}, *({"stereo": {"baseline_m": b_m, "subpixel_px": 0.3}} for b_m in (0.5, 0.1, 0.03))],
    "both": [{}, {"range_noise_m": 0.3, "dropout": 0.3}, {"range_noise_m": 1.0, "dropout": 0.5}],
}
SENSOR_KIND_BY_CHAIN = {"share of the range": "camera", "stereo": "camera", "missing returns": "lidar"}
WEATHERS = [
    {},
    {"visibility_m": 200.0},
    {"visibility_m": 60.0},
    {"visibility_m": 60.0, "rain_mm_h": 30.0, "road": "wet"},
]
# Metrics that a worse sensor cannot improve. The uniformity of points and s_mig_occluded may rise by definition, see
# the page on metrics; false_visible is a share of the invisible cells; others use no points of a rig.
PUBLISHED_WITH_LAW = ("object_coverage", "perception_entropy", "k_cover", "point_density")
EXCLUDED_METRIC = "point_uniformity"


def rig(kind, name, **changes):
    keys = {"type": kind, "mount": {"x_m": 1.8, "z_m": 1.6}, "max_range_m": 40, **RIG[kind], **changes}
    sensors = [{**keys, "name": "left"}, {**keys, "name": "right", "mount": {"x_m": 2.2, "y_m": -0.8, "z_m": 1.2}}]
    return Rig.model_validate({"name": name, "sensors": sensors})


def measure_numbers(rigs, num_frames=1, scenario=SCENARIO):
    """Measure all numbers of each rig."""
    reference = SurfaceReference(((AREA.x_m, AREA.y_m),), num_rays=1000, bands_m=((-0.5, 2.0),), points_per_object=32)
    frames = SimulatedFrames(scenario, rigs=rigs, num_frames=num_frames, reference_sensor=reference, boxes=True)
    observers = {}
    for name, measured_rig in rigs.items():
        sensors = [sensor.name for sensor in measured_rig.sensors]
        metric = CoverageMetric(
            GRID, (0.2, 0.4, 3.0), max_radius_m=30.0, aggregations=(Maximum(),), regions=(AREA,), sensor_names=sensors,
            has_area_weights=True,
        )  # fmt: skip
        setup = MetricSetup(
            name, measured_rig.sensors, None, GRID, (AREA,), threshold_m=0.4, query_cache=FrameQueryCache()
        )
        observers[name] = [
            CoverageObserver(metric, name),
            *(PUBLISHED[metric_name].build(setup) for metric_name in PUBLISHED_WITH_LAW),
        ]
    for frame in frames:
        for rig_observers in observers.values():
            for observer in rig_observers:
                observer.update(frame)
    numbers = {}
    for name, (coverage, *metrics) in observers.items():
        rig_numbers = {}
        for row in coverage.compute().summary():
            numbers_by_kind = {
                "": row.numbers,
                "known": row.cell_averages,
                "detecting sensors": row.redundancy.detecting_sensors,
                **row.redundancy.failure_numbers,
            }
            for kind, kind_numbers in numbers_by_kind.items():
                for key, number in kind_numbers.items():
                    rig_numbers[row.region, row.band, kind, key] = number
        for metric in metrics:
            rig_numbers |= {number.quantity.key: number for number in metric.compute()}
        numbers[name] = rig_numbers
    return numbers


def check_never_better(numbers):
    """Check the numbers of rigs or scenarios in the order from better to worse."""
    for better, worse in pairwise(numbers):
        for key, number in better.items():
            if str(key).startswith(EXCLUDED_METRIC) or number.value != number.value:
                continue
            gain = (worse[key].value - number.value) * (-1 if number.quantity.lower_is_better else 1)
            assert not gain > 1e-9, (key, number.value, worse[key].value)
    first, *_, last = (item["20m", "ground", "", "detection_0.4m"].value for item in numbers)
    assert first > last + 0.05


@pytest.mark.parametrize(
    ("kind", "chain"),
    [(kind, chain) for kind in RIG for chain in CHAINS if SENSOR_KIND_BY_CHAIN.get(chain, kind) == kind],
)
def test_sensor_errors_never_improve_coverage(kind, chain):
    rigs = {str(index): rig(kind, str(index), **keys) for index, keys in enumerate(CHAINS[chain])}
    check_never_better(list(measure_numbers(rigs).values()))


def test_weather_never_improves_coverage():
    sensor, keys = rig("lidar", "r", range_at_10_percent_m=40.0), SCENARIO.model_dump(exclude_unset=True)
    scenarios = [type(SCENARIO).model_validate({**keys, "weather": weather}) for weather in WEATHERS]
    check_never_better([measure_numbers({"r": sensor}, scenario=item)["r"] for item in scenarios])


def test_s_mig_falls_with_missing_returns():
    """The metric itself rises: by its published sign, less crossed space is better."""
    rigs = {str(index): rig("lidar", str(index), **keys) for index, keys in enumerate(CHAINS["missing returns"])}
    frame, captured = SimulatedFrames(SCENARIO, rigs=rigs, num_frames=1, boxes=True)[0], []
    for name, measured_rig in rigs.items():
        metric = SMig(measured_rig.sensors, 1.0, categories=("car",), ends_at_hits=True, rig_name=name)
        # The cars are present in every other frame.
        metric.update([frame, replace(frame, boxes=frame.boxes.select_categories())])
        captured.append(metric.compute()[0].parameters["entropy_captured_nats"])
    assert captured == sorted(captured, reverse=True)
    assert captured[-1] < captured[0]


@pytest.mark.parametrize("kind", RIG)
def test_exact_sensors_keep_their_numbers(kind):
    """Errors below the resolution of float32 do not change coverage."""
    exact, nearly = measure_numbers(
        {"exact": rig(kind, "exact"), "nearly": rig(kind, "nearly", range_noise_m=1e-9)}
    ).values()
    assert {key: number.value for key, number in exact.items()} == pytest.approx(
        {key: number.value for key, number in nearly.items()}, rel=0, abs=0, nan_ok=True
    )


@pytest.mark.parametrize("number", ["detection_0.2m", "radius_m", "detected_by_two_0.4m", "detection_0.4m_without_any"])
def test_searches_do_not_prefer_worse_sensors(number):
    common_frames = CommonFrames(
        [SCENARIO], {"asked": Objective(number=number, region="20m", band="ground")}, num_rays=1024
    )
    for chain in ("range noise", "drop-out", "missing returns"):
        rigs = [rig("lidar", "r", **keys) for keys in CHAINS[chain]]
        scores = [float(common_frames.score(candidate).estimate.value[0]) for candidate in rigs]
        scores = [-score for score in scores] if number == "radius_m" else scores
        assert scores == sorted(scores, reverse=True)
        assert scores[-1] < scores[0]


@pytest.mark.parametrize(
    ("kind", "chain"), [("lidar", "missing returns"), ("camera", "stereo"), *((kind, "both") for kind in RIG)]
)
def test_sensor_errors_add_no_points_to_targets(kind, chain):
    raster = Raster((4.0, 12.0), (-2.0, 2.0), 4.0)
    target_maps = [
        measure_target_visibility(rig(kind, "r", **keys), SCENARIO, Target.load("adult"), raster)
        for keys in CHAINS[chain]
    ]
    for exact, erring in pairwise(target_maps):
        assert (erring.points <= exact.points).all()
        assert not (erring.surface_share > exact.surface_share).any()
    assert target_maps[-1].points.sum() < target_maps[0].points.sum()
