"""The metrics of the package, as the contract is asked of them: how to make one, and steps to feed it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torchmetrics import Metric

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.contrib import (
    FalseVisible,
    FrameMetric,
    KCover,
    MSog,
    ObjectCoverage,
    PerceptionEntropy,
    PointDensity,
    SMig,
)
from torchcover.coverage import AGGREGATIONS, FrameQuantiles
from torchcover.data import Frame
from torchcover.detection import Boxes, RecallByVisibility
from torchcover.geometry import BoundingBox
from torchcover.metrics import MergeableMetric
from torchcover.simulation import Lidar, Pose

Step = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """One metric.

    Args:
        make: Makes it, with some of its parameters changed.
        frames: Arguments of `update`, by name, 8 steps or more.
        bland: A step after which metrics of other parameters have the same sums.
        changes: Other parameters, each under a text that starts with the name of the one that differs.
    """

    make: Callable[..., Metric]
    frames: Sequence[Step]
    bland: Step
    changes: Mapping[str, Step]

    def over(self, steps: Sequence[Step], **changes: Any) -> Metric:
        """The metric over some steps."""
        metric = self.make(**changes)
        for step in steps:
            metric.update(**step)
        return metric

    @cached_property
    def whole(self) -> tuple[dict[str, torch.Tensor], Any]:
        """The states and the result over all steps, which many laws compare with: not to be changed."""
        metric = self.over(self.frames)
        return {name: value.clone() for name, value in metric.metric_state.items()}, metric.compute()

    @cached_property
    def _results(self) -> dict[tuple[int, ...], Any]:
        return {}

    def after(self, *indices: int) -> Any:
        """The result over some steps, kept as `whole` is."""
        if indices not in self._results:
            self._results[indices] = self.over([self.frames[index] for index in indices]).compute()
        return self._results[indices]


def in_lists(steps: Sequence[Step]) -> dict[str, list[Any]]:
    """Several steps as one call of `update` takes them."""
    return {name: [step[name] for step in steps] for name in steps[0]}


def shares(steps: Sequence[Step]) -> tuple[Sequence[Step], Sequence[Step]]:
    """What each of two processes gets: the first of them a few early steps, the second all others."""
    early = 2 * (len(steps) // 8)
    return steps[:early:2], [*steps[1:early:2], *steps[early:]]


def flat(value: object, path: str = "") -> dict[str, object]:
    """Every tensor and every plain value that a result holds, by where it is."""
    if isinstance(value, Mapping):
        parts = value
    elif isinstance(value, tuple | list):
        parts = dict(enumerate(value))
    elif hasattr(value, "__dict__") and not isinstance(value, torch.Tensor):
        parts = vars(value)
    else:
        return {path: value}
    return {place: part for name, inner in parts.items() for place, part in flat(inner, f"{path}/{name}").items()}


# Coverage.

SHAPE = {"x_m": (-2.0, 2.0), "y_m": (-1.0, 1.0), "cell_m": 0.5}
BANDS = {"low": (-2.0, 0.0), "high": (0.0, 2.0)}
COVERAGE = {"grid": BevGrid(**SHAPE, heights=BANDS), "thresholds_m": (0.4, 0.8), "max_radius_m": 3.0}
ALL = tuple(kind.parse(kind.example) for kind in AGGREGATIONS)


def coverage_step(index: int) -> Step:
    generator = torch.Generator().manual_seed(index)
    sensor, reference = (torch.randn(count, 3, generator=generator) for count in (20, 60))
    return {
        "sensor": sensor,
        "reference": reference,
        "weights": torch.rand(60, generator=generator) + 0.1,
        "block_index": index,
    }


def coverage(steps: int, changes: Mapping[str, Step], **options: Any) -> Case:
    return Case(
        lambda **changed: CoverageMetric(**{**COVERAGE, **options, **changed}),
        [coverage_step(index) for index in range(steps)],
        {"sensor": torch.zeros(1, 3), "reference": torch.empty(0, 3), "weights": torch.empty(0), "block_index": 0},
        {
            "grid": {"grid": BevGrid(**{**SHAPE, "x_m": (-1.0, 3.0)}, heights=BANDS)},
            "grid, bands in another order": {"grid": BevGrid(**SHAPE, heights=dict(reversed(BANDS.items())))},
            "thresholds_m": {"thresholds_m": (1.0, 0.8)},
            "thresholds_m in another order": {"thresholds_m": (0.8, 0.4)},
            "thresholds_m, one less": {"thresholds_m": (0.4,)},
            "max_radius_m": {"max_radius_m": 4.0},
            "num_blocks": {"num_blocks": 16},
            **changes,
        },
    )


def by_sensor(steps: int) -> Case:
    def apart(step: Step) -> Step:
        return {**step, "sensor": {"roof": step["sensor"][:12], "rear": step["sensor"][12:]}}

    regions = (
        Region("left", (-2.0, 2.0), (0.0, 1.0)),
        Region.from_corners("corner", [(-2.0, -1.0), (2.0, -1.0), (0.0, 1.0)]),
    )
    whole = coverage(
        steps,
        {
            "sensor_names in another order": {"sensor_names": ("rear", "roof")},
            "regions": {"regions": regions[:1]},
            "has_area_weights": {"has_area_weights": False},
        },
        num_blocks=8,
        has_area_weights=True,
        sensor_names=("roof", "rear"),
        regions=regions,
    )
    # Regions are within the other cases' grid only.
    changes = {name: change for name, change in whole.changes.items() if name != "grid"}
    return replace(whole, frames=[apart(step) for step in whole.frames], bland=apart(whole.bland), changes=changes)


# Detection.


def detection_step(seed: int) -> Step:
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([120.0, 60, 1, 4, 2, 1, 6])
    count = seed % 9
    truth, false = (torch.rand(n, 7, generator=generator) * size + 0.3 for n in (count, 4))
    jitter = torch.randn(count, 7, generator=generator) * torch.tensor([1.2, 1.2, 0, 0, 0, 0, 0])
    share, scores, own = (torch.rand(n, generator=generator).double() for n in (count, count + 4, count + 4))
    share[torch.rand(count, generator=generator) < 0.2] = math.nan
    return {
        "detections": torch.cat([truth + jitter, false]),
        "boxes": Boxes.from_rows(truth),
        "visibility": share,
        "scores": scores,
        "detection_visibility": own,
    }


# Published by others, over frames.


def frame_step(index: int) -> Step:
    generator = torch.Generator().manual_seed(index)
    count = index // 3 % 5
    rows = torch.rand(count, 7, generator=generator) * torch.tensor([50.0, 8, 0.5, 3, 2, 1, 3])
    rows += torch.tensor([3.0, -4, 0.5, 1, 1, 1, 0])
    # A few points anywhere, and on objects.
    reference, cloud = torch.rand(2, 60, 3, generator=generator) * torch.tensor([8.0, 4.0, 2.0])
    near = rows[:, :3].repeat(8, 1) + 0.4 * torch.randn(8 * count, 3, generator=generator)
    categories = tuple("car" if number % 2 else "pedestrian" for number in range(count))
    frame = Frame(
        {"rig": torch.cat([cloud, near[::2]])},
        torch.cat([reference, near]),
        index=index,
        name=f"frame {index}",
        reference_weights=torch.rand(60 + 8 * count, generator=generator) + 0.1,
        boxes=Boxes.from_rows(rows, categories=categories),
        sensor_point_counts={"rig": {"front": 25, "rear": 35 + 4 * count}},
    )
    return {"frame": frame}


PLACES = {
    "grid": BevGrid(x_m=(0.0, 8.0), y_m=(0.0, 4.0), cell_m=0.5),
    "regions": (Region("near", (0.0, 4.0), (0.0, 4.0)),),
}
OTHER_GRID = {"grid": BevGrid(x_m=(0.0, 10.0), y_m=(0.0, 4.0), cell_m=0.5)}
SENSORS = (
    Lidar(
        name="front",
        mount=Pose(z_m=1.0),
        channels=2,
        vertical_fov_deg=(-20, 0),
        columns=8,
        horizontal_fov_deg=90,
        max_range_m=20,
    ),
)


BOTH = (*SENSORS, SENSORS[0].model_copy(update={"name": "rear", "mount": Pose(z_m=1.0, x_m=0.5)}))
VOXELS = {"sensors": BOTH, "voxel_m": 0.5, "region": BoundingBox((0.0, -4.0, 0.0), (16.0, 4.0, 2.0))}
OF_VOXELS = {
    "sensors": {"sensors": (BOTH[0].model_copy(update={"max_range_m": 5.0}), BOTH[1])},
    "voxel_m": {"voxel_m": 1.0},
    "region": {"region": BoundingBox((0.0, -4.0, 0.0), (12.0, 4.0, 2.0))},
}


def as_metric(kind: type[FrameMetric]) -> type[Metric]:
    """The metric of torchmetrics over sums that have none of their own; found by name, as pickle needs it."""
    name = f"{kind.__name__}Metric"
    return globals().setdefault(name, type(name, (MergeableMetric, kind), {"__module__": __name__}))


def of_frames(kind: type[FrameMetric], usual: Step, changes: Mapping[str, Step]) -> Case:
    nothing = Frame(
        {"rig": torch.zeros(0, 3)},
        torch.zeros(0, 3),
        0,
        "nothing",
        reference_weights=torch.zeros(0),
        boxes=Boxes.from_rows(torch.zeros(0, 7)),
        sensor_point_counts={"rig": {"front": 0, "rear": 0}},
    )
    return Case(
        lambda **changed: as_metric(kind)(**{**usual, **changed}),
        [frame_step(index) for index in range(0, 24, 3)],  # blocks are paired up
        {"frame": nothing},
        {**changes, "rig_name": {"rig_name": "rig"}},
    )


CASES = {
    "coverage": coverage(12, {}),
    "coverage, everything": coverage(
        24,
        {
            "aggregations, one less": {"aggregations": ALL[1:]},
            "aggregations in another order": {"aggregations": ALL[::-1]},
            "aggregations, other levels": {
                "aggregations": (*(one for one in ALL if not isinstance(one, FrameQuantiles)), FrameQuantiles((0.9,)))
            },
        },
        num_blocks=8,
        aggregations=ALL,
    ),
    "coverage, by sensor": by_sensor(24),
    "coverage, by area": coverage(
        24, {"has_area_weights": {"has_area_weights": False}}, num_blocks=8, has_area_weights=True
    ),
    "recall": Case(
        lambda **changed: RecallByVisibility(**{"score_thresholds": (0.0, 0.5), **changed}),
        [detection_step(seed) for seed in range(24)],
        {
            "detections": torch.empty(0, 7),
            "boxes": Boxes.from_rows(torch.empty(0, 7)),
            "visibility": torch.empty(0),
            "scores": torch.empty(0),
            "detection_visibility": torch.empty(0),
        },
        {
            "match_by": {"match_by": "iou", "threshold": 0.9},
            "threshold": {"threshold": 0.5},
            "visibility_borders": {"visibility_borders": (0.1, 0.4, 0.6, 0.8)},
            "distance_borders": {"distance_borders": (10.0, 20.0)},
            "score_thresholds": {"score_thresholds": (0.0, 0.9)},
        },
    ),
    "object coverage": of_frames(
        ObjectCoverage,
        {"categories": ("car", "pedestrian"), "range_borders_m": (20.0,)},
        {
            "threshold_m": {"threshold_m": 0.2},
            "min_point_counts": {"min_point_counts": (2,)},
            "categories": {"categories": ("pedestrian", "car")},
            "range_borders_m": {"range_borders_m": (30.0,)},
        },
    ),
    "perception entropy": of_frames(
        PerceptionEntropy, {}, {"categories": {"categories": ("car",)}, "range_borders_m": {"range_borders_m": (9.0,)}}
    ),
    "k-cover": of_frames(
        KCover,
        PLACES,
        {
            "grid": OTHER_GRID,
            "regions": {"regions": ()},
            "threshold_m": {"threshold_m": 0.2},
            "min_sensor_counts": {"min_sensor_counts": (1, 2)},
            "has_area_weights": {"has_area_weights": False},
        },
    ),
    "point density": of_frames(
        PointDensity,
        PLACES,
        {
            "grid": OTHER_GRID,
            "regions": {"regions": (Region("near", (0.0, 2.0), (0.0, 4.0)),)},
        },
    ),
    "false visible": of_frames(
        FalseVisible,
        {"sensors": SENSORS, "ego_mesh": None, "grid": PLACES["grid"]},
        {
            "grid": OTHER_GRID,
            "threshold_m": {"threshold_m": 0.2},
            "cell_m": {"cell_m": 0.5},
            "predicted": {"sensors": (SENSORS[0].model_copy(update={"max_range_m": 5.0}),)},
        },
    ),
    "s-mig": of_frames(
        SMig, VOXELS, {**OF_VOXELS, "categories": {"categories": ("car",)}, "ends_at_hits": {"ends_at_hits": True}}
    ),
    "s-mig, occluded": of_frames(SMig, {**VOXELS, "ends_at_hits": True}, OF_VOXELS),
    "m-sog": of_frames(MSog, VOXELS, {**OF_VOXELS, "category": {"category": "pedestrian"}}),
}
