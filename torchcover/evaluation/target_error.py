"""A run ends once its numbers are good enough: target errors, how far each number is from them, what was reached."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

from torchcover.coverage import Coverage, Region, list_region_bands
from torchcover.estimation import ROUND_OFF, ErrorModel
from torchcover.evaluation.observers import Observer
from torchcover.report import to_json_record

# An error from fewer steps is not believed, though they may fill enough blocks; nor is one that is small enough once,
# for the looks at which it happens to be too small are those that would end the run.
MIN_STEPS = 64
LOOKS_IN_A_ROW = 2
# Errors are looked at when they should have become small enough, but after 4 to 50 % more steps: a run is as much too
# long as two looks are apart.
MIN_GROWTH, MAX_GROWTH = 1.04, 1.5


@dataclass(frozen=True)
class TargetError:
    """The largest standard errors that are good enough; None where any is.

    Args:
        radius_m: Of every radius in metres.
        detection: Of every detection, as a share.

    Raises:
        ValueError: Neither, or one that is not positive and finite.
    """

    radius_m: float | None = None
    detection: float | None = None

    def __post_init__(self) -> None:
        given = {name: size for name, size in vars(self).items() if size is not None}
        if not given:
            raise ValueError("target error: radius_m, detection or both are needed; got neither")
        for name, size in given.items():
            if not 0 < size < math.inf:
                raise ValueError(f"target error: {name} must be positive and finite; got {size}")

    @classmethod
    def parse(cls, text: str | Sequence[str]) -> "TargetError | None":
        """Read numbers with their units; None for no words.

        Raises:
            ValueError: Not a positive number with % or m, or two with the same unit.
            TypeError: Not words.

        Example:
            >>> TargetError.parse(["0.1%", "0.02m"])
            TargetError(radius_m=0.02, detection=0.001)
        """
        each = [text] if isinstance(text, str) else text
        if not isinstance(each, Sequence) or not all(isinstance(word, str) for word in each):
            raise TypeError(
                f'target error: numbers with their units are needed, "0.1%" or ["0.1%", "0.02m"], or a '
                f"TargetError; got {text!r}"
            )
        found: dict[str, float] = {}
        for word in each:
            parts = re.fullmatch(r"([0-9.]+(?:e-?[0-9]+)?) ?(%|m)", word.strip())
            try:
                size = float(parts[1]) if parts else math.nan
            except ValueError:
                size = math.nan
            if not parts or not 0 < size < math.inf:
                raise ValueError(
                    f"target error {word}: a positive number with its unit is needed, 0.1% for the detection or "
                    "0.02m for the radius"
                )
            name, size = ("radius_m", size) if parts[2] == "m" else ("detection", size / 100)
            if name in found:
                raise ValueError(f"target error {word}: another number in {parts[2]} was given before; give one")
            found[name] = size
        return cls(**found) if found else None


@dataclass(frozen=True)
class ConvergenceStatus:
    """How far a number is from the error that is good enough.

    Args:
        rig: Whose number, or `B minus A` for a difference.
        region: Name of the region.
        band: Name of the height band.
        quantity: As in the columns of `summary.csv`.
        error: Standard error now, in metres or as a share; NaN if there are not enough steps.
        target: What is good enough.
        num_frames: Steps so far.
    """

    rig: str
    region: str
    band: str
    quantity: str
    error: float
    target: float
    num_frames: int

    @property
    def is_reached(self) -> bool:
        """Whether it is good enough, and known well enough to say so."""
        return self.num_frames >= MIN_STEPS and self.error <= self.target

    @property
    def excess(self) -> float:
        """How many times the error is what it should be; infinite if it is not known."""
        return math.inf if math.isnan(self.error) else self.error / self.target

    @property
    def frames_needed(self) -> int | None:
        """Steps after which it should be good enough, for errors fall as 1 / sqrt(steps); None if there is no error."""
        if math.isinf(self.excess):
            return None
        return max(
            MIN_STEPS,
            self.num_frames
            if self.is_reached
            else ErrorModel.from_error(self.error, self.num_frames).estimate_num_frames(self.target) or 0,
        )

    @property
    def text(self) -> str:
        """Error and target."""
        return f"error {_measure(self.error, self.quantity)} (target {_measure(self.target, self.quantity)})"


def compute_convergence(
    target: TargetError, coverages: Mapping[str, Coverage], regions: Sequence[Region]
) -> list[ConvergenceStatus]:
    """How far every number is: those of each rig, and the differences to the first rig.

    A number that is unknown, for want of a known cell, has no error, and nothing waits for it.

    Args:
        target: What is good enough.
        coverages: What `CoverageMetric.compute` returned, by the name of the rig, from the same frames.
        regions: Regions within the grid.
    """
    (first_name, first), *_ = coverages.items()
    found = []
    for region, height in list_region_bands(regions, first.grid):
        estimates = {name: coverage.estimate(region, height) for name, coverage in coverages.items()}
        others = [name for name in estimates if name != first_name]
        paired = {f"{name} minus {first_name}": estimates[name].subtract(estimates[first_name]) for name in others}
        for name, estimate in (estimates | paired).items():
            numbers = zip(first.quantities, estimate.value.tolist(), estimate.error.tolist(), strict=True)
            for quantity, value, error in numbers:
                good = target.radius_m if quantity.unit == "m" else target.detection
                if good is not None and not math.isnan(value):
                    where = (name, region.name, height, quantity.key)
                    found.append(ConvergenceStatus(*where, error, good, first.counts["num_frames"]))
    return found


class TargetErrorRule:
    """Looks at the errors of a run now and then: what `observe` takes as `until`.

    Args:
        target: What is good enough.
        observers: Those whose coverage it is, by the name of the rig.
        regions: Regions within their grid.
    """

    def __init__(
        self, target: TargetError, observers: Mapping[str, Observer[Coverage]], regions: Sequence[Region]
    ) -> None:
        self.target = target
        self.observers = observers
        self.regions = regions
        self.next_check_frame = MIN_STEPS
        self.worst: ConvergenceStatus | None = None
        self._good_looks = 0

    def is_reached(self, num_frames: int) -> bool:
        """Whether the run may end after so many steps. Between two looks: no."""
        if num_frames < self.next_check_frame:
            return False
        coverages = {name: observer.compute() for name, observer in self.observers.items()}
        found = compute_convergence(self.target, coverages, self.regions)
        self.worst = max(found, key=lambda standing: standing.excess, default=None)
        self._good_looks = self._good_looks + 1 if self.worst is not None and self.worst.is_reached else 0
        if self._good_looks >= LOOKS_IN_A_ROW:
            return True
        needed = math.inf if self.worst is None else self.worst.frames_needed or math.inf
        self.next_check_frame = math.ceil(min(max(needed, MIN_GROWTH * num_frames), MAX_GROWTH * num_frames))
        return False

    def state_dict(self) -> dict[str, Any]:
        """When it looks again, and what the last looks said."""
        return {
            "next_check_frame": self.next_check_frame,
            "good_looks": self._good_looks,
            "worst": None if self.worst is None else asdict(self.worst),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on as another one would have."""
        self.next_check_frame, self._good_looks = state_dict["next_check_frame"], state_dict["good_looks"]
        self.worst = None if state_dict["worst"] is None else ConvergenceStatus(**state_dict["worst"])

    def estimate_num_frames(self, max_frames: int) -> int:
        """Steps that the run is thought to take, of so many at most."""
        if self.worst is None or self.worst.frames_needed is None:
            return max_frames
        return min(max_frames, max(self.worst.frames_needed, self.next_check_frame))

    @property
    def progress_text(self) -> str:
        """The worst error and its target."""
        return self.worst.text if self.worst else ""


def _measure(error: float, quantity: str) -> str:
    return f"{error:.2g} m" if quantity == "radius_m" else f"{100 * error:.2g} %"


def summarize_target_error(
    target: TargetError | None, coverages: Mapping[str, Coverage], regions: Sequence[Region], *, is_confirmed: bool
) -> tuple[dict[str, Any] | None, list[str]]:
    """What was aimed at and what was reached at the end of a run.

    Args:
        target: What is good enough; None if nothing was aimed at.
        coverages: As in `standings`.
        regions: Regions within the grid.
        is_confirmed: Whether the run has ended because every number was good enough at two looks in a row.

    Returns:
        A record for `summary.json`, with errors in metres or as shares, and lines for the terminal.
    """
    if target is None:
        return None, []
    found, first = compute_convergence(target, coverages, regions), next(iter(coverages.values()))
    blank = [f"{row.region} {row.band}" for row in first.summary(regions) if not row.observed_cells]
    lines = _lines(found, first.counts["num_frames"], confirmed=is_confirmed)
    if blank:
        lines.append(f"Not waited for, as no cell of it is known: {', '.join(blank)}.")
    if alike := [f"{one.region} {one.band}, {one.quantity} of {one.rig}" for one in found if one.error <= ROUND_OFF]:
        lines.append(f"Not waited for, as all steps say the same, which proves nothing: {'; '.join(alike)}.")
    return {**_record(target, found), "reached": is_confirmed, "unknown": blank}, lines


def _record(target: TargetError, found: Sequence[ConvergenceStatus]) -> dict[str, Any]:
    needed = [standing.frames_needed for standing in found]
    known = [steps for steps in needed if steps is not None]
    numbers = []
    for standing, steps in zip(found, needed, strict=True):
        record = {name: value for name, value in asdict(standing).items() if name != "num_frames"}
        numbers.append(to_json_record({**record, "reached": standing.is_reached, "frames_needed": steps}))
    return {
        **asdict(target),
        "frames_needed": max(known) if known and len(known) == len(needed) else None,
        "numbers": numbers,
    }


def _lines(found: Sequence[ConvergenceStatus], steps: int, *, confirmed: bool) -> list[str]:
    """That it was reached, or the worst number of each region and band and what it would take."""
    if not found:
        return ["Target error not reached: no region has a known cell."]
    if confirmed:
        return [f"Target error reached after {steps:,} steps."]
    after = f"Target error not reached in {steps:,} step{'s' * (steps != 1)}"
    if all(standing.is_reached for standing in found):
        return [f"{after}: every error is small enough now, but was not at two looks in a row; take more steps."]
    lines = [f"{after}; the largest of each region:"]
    for (region, height), group in groupby(found, key=lambda standing: (standing.region, standing.band)):
        worst = max(group, key=lambda standing: standing.excess)
        where = f"  {region} {height}, {worst.quantity} of {worst.rig}"
        if worst.frames_needed is None:
            lines.append(f"{where}: not enough steps for an error")
        elif worst.is_reached:
            lines.append(f"{where}: {worst.text}, reached")
        else:
            needed = f"about {round_up_frames(worst.frames_needed):,} different steps are needed"
            lines.append(f"{where}: {worst.text}, {needed}")
    return lines


def round_up_frames(num_frames: int) -> int:
    """Steps in two digits, never fewer.

    Example:
        >>> round_up_frames(99), round_up_frames(1234)
        (99, 1300)
    """
    unit: int = 10 ** max(0, len(str(num_frames)) - 2)
    return -(-num_frames // unit) * unit
