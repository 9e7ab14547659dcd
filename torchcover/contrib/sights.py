"""What several metrics ask of the same frame and rig, found once."""

from collections.abc import Callable
from typing import Any, TypeVar

import torch
from torch import Tensor

from torchcover.contrib.object_strata import ObjectStrata
from torchcover.coverage import BevGrid
from torchcover.coverage.grid import Bins
from torchcover.coverage.quantity import MEASURED_WITHIN_M
from torchcover.detection import Boxes, points_in_boxes
from torchcover.detection.inside import Inside
from torchcover.frames import Frame
from torchcover.neighbors import check_cloud, nearest
from torchcover.neighbors.choice import backend_of_several

Found = TypeVar("Found")

NO_BOXES = (
    "{}: the frame has no boxes, and the metric is about objects: SimulatedFrames(..., boxes=True) makes them, a "
    "recording has them if its format does; else use dataclasses.replace(frame, boxes=...)"
)


class Sights:
    """Remembers what was found in the last frame. Metrics of a run, of all its rigs, share one; a copy starts anew.

    Example:
        >>> frame = Frame({"rig": torch.zeros(1, 3)}, torch.tensor([[0.3, 0.0, 0.0], [3.0, 0.0, 0.0]]), 0, "a")
        >>> Sights().distance(frame, "rig", 0.4)
        tensor([0.3000,    inf])
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._found: dict[tuple[Any, ...], Any] = {}
        self._of_all: tuple[tuple[Any, ...], Any] | None = None
        # Whether a metric asks for single sensors: then the rig as a whole takes no search of its own.
        self.by_sensor = False

    def __reduce__(self) -> tuple[type["Sights"], tuple[()], dict[str, bool]]:
        return Sights, (), {"by_sensor": self.by_sensor}

    def distance(self, frame: Frame, rig: str, within_m: float) -> Tensor:
        """(M,) metres from each reference point to the nearest point of the rig; infinite where none is within reach.

        Points that were measured farther off than that are none.
        """
        if self.by_sensor:
            return self.of_sensors(frame, rig, within_m).amin(dim=0)
        return self.once(
            frame, ("rig", rig, within_m), lambda: _search(frame, frame.cloud_of(rig, within_m=within_m), within_m)
        )

    def of_sensors(self, frame: Frame, rig: str, within_m: float) -> Tensor:
        """(S, M) the same for each sensor of the rig.

        Raises:
            ValueError: Which points are of which sensor is unknown.
        """

        def search() -> Tensor:
            clouds = list(frame.clouds_by_sensor(rig, within_m=within_m).values())
            backend = backend_of_several(frame.reference, clouds)
            return torch.stack([_search(frame, cloud, within_m, backend) for cloud in clouds])

        return self.once(frame, ("sensors", rig, within_m), search)

    def boxes(self, frame: Frame) -> Boxes:
        """The objects of the frame.

        Raises:
            ValueError: The frame has none; the message says how to get them.
        """
        if frame.boxes is None:
            raise ValueError(NO_BOXES.format(f"frame {frame.name!r}"))
        return frame.boxes

    def reference_in_boxes(self, frame: Frame) -> Inside:
        """Which reference points lie in which objects."""
        return self.once(frame, ("boxes",), lambda: points_in_boxes(frame.reference, self.boxes(frame)))

    def members(self, frame: Frame, strata: ObjectStrata) -> Tensor:
        """(strata, K) float64: 1 where an object is one of them."""
        what = ("strata", *strata.meaning.values())
        return self.once(frame, what, lambda: strata.members(self.boxes(frame)))

    def hits(self, frame: Frame, rig: str) -> Tensor:
        """(K,) int64 how many points of the rig lie in each object."""
        boxes = self.boxes(frame)
        if rig in boxes.hits:
            return boxes.hits[rig]
        points = frame.cloud_of(rig, within_m=MEASURED_WITHIN_M)
        return self.once(frame, ("hits", rig), lambda: count_in_boxes(points, boxes))

    def bins(self, frame: Frame, grid: BevGrid) -> Bins:
        """In which cells of a grid the reference points are."""
        return self.once(frame, ("bins", grid), lambda: grid.bins(frame.reference, frame.heights_in(grid.band_frame)))

    def once(self, frame: Frame, what: tuple[Any, ...], find: Callable[[], Found]) -> Found:
        """Whatever is to be found in a frame; looked for when it is first asked for."""
        if frame is not self._frame:
            self._frame, self._found = frame, {}
        if what not in self._found:
            self._found[what] = find()
        found: Found = self._found[what]
        return found

    def after_all(self, what: tuple[Any, ...], find: Callable[[], Found]) -> Found:
        """Whatever is to be found from what all frames left; remembered until something else is asked for."""
        if self._of_all is None or self._of_all[0] != what:
            self._of_all = what, find()
        found: Found = self._of_all[1]
        return found


def rig_of(frame: Frame, rig: str | None) -> str:
    """The name of the rig; of the only one if none is given. ValueError: there is no such rig, or there are several."""
    frame.cloud_of(rig)
    return next(iter(frame.clouds)) if rig is None else rig


def count_in_boxes(cloud: Tensor, boxes: Boxes) -> Tensor:
    """(K,) int64 how many points lie in each of K boxes."""
    return torch.bincount(points_in_boxes(cloud, boxes).box, minlength=len(boxes))


def _search(frame: Frame, cloud: Tensor, within_m: float, backend: str = "auto") -> Tensor:
    check_cloud(frame.reference, "reference")
    check_cloud(cloud, "sensor")
    return nearest(frame.reference, cloud, max_distance=within_m, backend=backend).distance
