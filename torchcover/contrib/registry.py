"""The metrics of others by the names that `--set metrics=NAME` takes: what they need, and how one is made."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from torchcover.contrib.false_visible import FalseVisible, coarse_grid
from torchcover.contrib.frame_metric import FrameMetric
from torchcover.contrib.k_cover import KCover
from torchcover.contrib.m_sog import MSog
from torchcover.contrib.object_coverage import ObjectCoverage
from torchcover.contrib.perception_entropy import PerceptionEntropy
from torchcover.contrib.point_density import PointDensity
from torchcover.contrib.s_mig import SMig
from torchcover.contrib.sights import Sights
from torchcover.coverage import BevGrid, Region, forward_regions
from torchcover.simulation import Sensor
from torchcover.simulation.shapes import Mesh

# boxes: `Frame.boxes`. sensors: the rig's sensors, with mounts and rays. sensor_points: which points are of which
# sensor.
Need: TypeAlias = Literal["boxes", "sensors", "sensor_points"]

GRID = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0))
# Of smaller cells most are empty whatever the rig.
UNIFORMITY_CELL_M = 1.0


@dataclass(frozen=True)
class Setup:
    """What metrics of one rig are made from.

    Args:
        rig: Its name in `Frame.clouds`; the only one if not given.
        sensors: Its sensors; empty if they are unknown.
        ego: The body that carries it, in the vehicle frame; None if it is unknown.
        grid: Cells and height bands of the run.
        regions: Those that numbers are given for.
        square_metres: Whether frames have the square metres of their reference points.
        threshold_m: Distance within which a point counts as seen.
        sights: What metrics of the same run share, so that each frame is searched once.
        sync_on_compute: As in `torchmetrics.Metric`.
    """

    rig: str | None = None
    sensors: Sequence[Sensor] = ()
    ego: Mesh | None = None
    grid: BevGrid = GRID
    regions: Sequence[Region] = field(default_factory=forward_regions)
    square_metres: bool = True
    threshold_m: float = 0.4
    sights: Sights = field(default_factory=Sights)
    sync_on_compute: bool = True

    @property
    def of_frames(self) -> dict[str, Any]:
        """The arguments that metrics of what frames show have in common."""
        return {"rig": self.rig, "sights": self.sights, "sync_on_compute": self.sync_on_compute}


@dataclass(frozen=True)
class Published:
    """A metric by its name in `--set metrics=NAME`.

    Args:
        make: Makes it.
        needs: What it cannot do without.
        words: What it says, in a line.
    """

    make: Callable[[Setup], FrameMetric]
    needs: frozenset[Need]
    words: str


def _point_density(setup: Setup) -> PointDensity:
    # A region that is smaller than a cell of 1 m needs the cells of the run.
    coarse = coarse_grid(setup.grid, UNIFORMITY_CELL_M)
    fits = all(region.mask(coarse).any() for region in setup.regions)
    return PointDensity(coarse if fits else setup.grid, setup.regions, **setup.of_frames)


PUBLISHED: Mapping[str, Published] = {
    "object_coverage": Published(
        lambda setup: ObjectCoverage(setup.threshold_m, **setup.of_frames),
        frozenset({"boxes"}),
        "share of an object within the threshold; objects with 1, 5, 10 points",
    ),
    "perception_entropy": Published(
        lambda setup: PerceptionEntropy(setup.sensors, **setup.of_frames),
        frozenset({"boxes"}),
        "nats of a detector's error, from points on objects (Ma 2021)",
    ),
    "k_cover": Published(
        lambda setup: KCover(
            setup.grid, setup.regions, setup.threshold_m, square_metres=setup.square_metres, **setup.of_frames
        ),
        frozenset({"sensor_points"}),
        "share of the surface seen by 1, 2, 3 sensors",
    ),
    "point_density": Published(_point_density, frozenset(), "points, for each square metre, and how evenly"),
    "false_visible": Published(
        lambda setup: FalseVisible(setup.sensors, setup.ego, setup.grid, setup.threshold_m, **setup.of_frames),
        frozenset({"sensors"}),
        "blind cells that the field of view promised (Börger 2022)",
    ),
    "s_mig": Published(
        lambda setup: SMig(setup.sensors, **setup.of_frames),
        frozenset({"boxes", "sensors"}),
        "minus the entropy of objects along the rays, in nats (Hu 2022)",
    ),
    "s_mig_occluded": Published(
        lambda setup: SMig(setup.sensors, occlusion=True, **setup.of_frames),
        frozenset({"boxes", "sensors", "sensor_points"}),
        "the same, up to what the rays hit",
    ),
    "m_sog": Published(
        lambda setup: MSog(setup.sensors, **setup.of_frames),
        frozenset({"boxes", "sensors"}),
        "minus the mean entropy of labels along the rays (Place3D 2024)",
    ),
}


def metric_names(given: str | Iterable[str]) -> tuple[str, ...]:
    """The metrics that a user asks for; "all" is all of them.

    Raises:
        ValueError: No such metric.
    """
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else list(given)
    if names == ["all"]:
        return tuple(PUBLISHED)
    for name in names:
        if name not in PUBLISHED:
            raise ValueError(f"metrics: all, or some of {', '.join(PUBLISHED)}, separated by commas; got {name!r}")
    return tuple(dict.fromkeys(names))
