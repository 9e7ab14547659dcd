"""How much of what is not seen was thought to be visible."""

import hashlib
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchcover.coverage import BevGrid
from torchcover.frames import Frame
from torchcover.published.field_of_view import field_of_view
from torchcover.published.places import coarse_grid
from torchcover.published.sights import Sights, rig_of
from torchcover.published.world_ratios import Ratio, WorldRatios
from torchcover.simulation import Sensor
from torchcover.simulation.shapes import Mesh


class FalseVisible(WorldRatios):
    """Of the cells that the rig does not see, the share that its field of view says it does: FVR = FV / (FV + TI).

    A cell is predicted visible if a ray crosses it in an empty world; see `field_of_view`. In a frame it is truly
    visible if the rig has a point within the threshold of a reference point there (detection > 0), and invisible if
    of none; a cell without reference points is unknown and does not count. FV is predicted visible and invisible, TI
    invisible either way predicted and found (after Börger et al. 2022).

    Args:
        sensors: The rig's sensors.
        ego: The vehicle's body; None if nobody knows it: then it hides nothing from the prediction.
        grid: Extent and height bands; its cells are made `cell_m` long.
        threshold_m: Distance within which a point counts as seen.
        cell_m: Side of the cells.
        rig: Whose clouds; those of the only rig if not given.
        sights: What metrics of a run share.
        kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: No sensors: of a recording, name the rig or give its file; a threshold that is negative.

    Example:
        >>> from torchcover.simulation import Rig
        >>> metric = FalseVisible(Rig.load("front_roof_32").sensors, None, BevGrid(x=(0.0, 40.0), y=(-5.0, 5.0)))
        >>> hidden = torch.tensor([[30.5, 0.5, 0.0], [0.5, 0.5, 0.0]])
        >>> metric.update(Frame({"rig": torch.zeros(0, 3)}, hidden, 0, "a"))
        >>> [(one.name, one.value) for one in metric.compute()]
        [('false_visible_ground_0.4m_1m', 0.5), ('false_visible_obstacle_0.4m_1m', nan)]
    """

    def __init__(
        self,
        sensors: Sequence[Sensor],
        ego: Mesh | None,
        grid: BevGrid,
        threshold_m: float = 0.4,
        cell_m: float = 1.0,
        *,
        rig: str | None = None,
        sights: Sights | None = None,
        **kwargs: Any,  # noqa: ANN401  (whatever torchmetrics takes)
    ) -> None:
        if not sensors:
            raise ValueError(
                "false_visible: the rig's sensors are needed, with mounts and rays; for a recording give the rig's "
                "YAML file (or the name of a built-in one)"
            )
        if not 0 <= threshold_m < float("inf"):
            raise ValueError(f"threshold_m: a finite distance >= 0 in metres is needed; got {threshold_m}")
        coarse = coarse_grid(grid, cell_m)
        predicted = field_of_view(sensors, coarse, ego)
        given = {"threshold_m": float(threshold_m), "cell_m": float(cell_m)}
        ratios = [
            Ratio(f"false_visible_{band}_{threshold_m:g}m_{cell_m:g}m", "share", False, "invisible cells", given)
            for band in coarse.heights
        ]
        fingerprint = hashlib.sha256(predicted.numpy().tobytes()).hexdigest()
        super().__init__(ratios, {**given, "grid": coarse, "predicted": fingerprint}, rig, **kwargs)
        self.grid = coarse
        self.predicted = predicted.flatten()
        self.threshold_m = float(threshold_m)
        self.sights = Sights() if sights is None else sights

    def _of_frame(self, frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
        seen = self.sights.distance(frame, rig_of(frame, self.rig), self.threshold_m) <= self.threshold_m
        inside, of, cell = self.sights.bins(frame, self.grid)
        known = torch.zeros(self.grid.cells, dtype=torch.bool, device=cell.device)
        visible = known.clone()
        known[cell] = True
        visible[cell[seen[inside[of]]]] = True
        invisible = (known & ~visible).view(len(self.ratios), -1)
        false_visible = invisible & self.predicted.to(cell.device).view(invisible.shape)
        base = invisible.sum(dim=1)
        return base.double(), false_visible.sum(dim=1).double(), base
