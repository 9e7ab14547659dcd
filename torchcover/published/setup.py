"""What a run can tell a metric of others, and what such a metric needs of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from torchcover.coverage import BevGrid, Region, forward_regions
from torchcover.published.frame_metric import FrameMetric
from torchcover.published.sights import Sights
from torchcover.simulation import Sensor
from torchcover.simulation.shapes import Mesh

# boxes: `Frame.boxes`. sensors: the rig's sensors, with mounts and rays. sensor_points: which points are of which
# sensor. m2: the square metres of the reference points. tags: classes of the reference points.
Need: TypeAlias = Literal["boxes", "sensors", "sensor_points", "m2", "tags"]

GRID = BevGrid(x=(-40.0, 160.0), y=(-40.0, 40.0))


@dataclass(frozen=True)
class Setup:
    """What metrics of one rig are made from.

    Args:
        rig: Its name in `Frame.clouds`; the only one if not given.
        sensors: Its sensors; empty if nobody knows them.
        ego: The body that carries it, in the vehicle frame; None if nobody knows it.
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
    """A metric by its name in `torchcover compare --metrics`.

    Args:
        make: Makes it.
        needs: What it cannot do without.
        words: What it says, in a line.
    """

    make: Callable[[Setup], FrameMetric]
    needs: frozenset[Need]
    words: str
