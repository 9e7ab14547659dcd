"""Target errors: standard errors at which a run stops, the rule that stops it, and a summary of what was reached."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from operator import attrgetter
from typing import Any

from torchcover.coverage import Coverage, Region, list_region_bands
from torchcover.estimation import ROUND_OFF, ErrorModel
from torchcover.evaluation.observers import Observer
from torchcover.report import to_json_record

# Standard errors of fewer frames are unreliable, even if the frames fill enough blocks.
MIN_FRAMES = 64


@dataclass(frozen=True)
class TargetError:
    """Largest accepted standard errors; None accepts any error.

    Args:
        radius_m: Standard error of every radius in meters.
        detection: Standard error of every detection rate, as a share.

    Raises:
        ValueError: Neither is given, or one is not positive and finite.
    """

    radius_m: float | None = None
    detection: float | None = None

    def __post_init__(self) -> None:
        if self.radius_m is None and self.detection is None:
            raise ValueError("target error: radius_m, detection or both are needed; got neither")
        for name, error in vars(self).items():
            if error is not None and not 0 < error < math.inf:
                raise ValueError(f"target error: {name} must be positive and finite; got {error}")

    @classmethod
    def parse(cls, text: str | Sequence[str]) -> "TargetError | None":
        """Parse errors with their units.

        Args:
            text: One text or several, such as "0.1%" for detection rates or "0.02m" for radii.

        Returns:
            The target error; None for an empty sequence.

        Raises:
            ValueError: Not a positive number with % or m, or two errors with the same unit.
            TypeError: Not texts.

        Example:
            >>> TargetError.parse(["0.1%", "0.02m"])
            TargetError(radius_m=0.02, detection=0.001)
        """
        texts = [text] if isinstance(text, str) else text
        if not isinstance(texts, Sequence) or not all(isinstance(word, str) for word in texts):
            raise TypeError(
                f'target error: numbers with their units are needed, "0.1%" or ["0.1%", "0.02m"], or a '
                f"TargetError; got {text!r}"
            )
        errors: dict[str, float] = {}
        for word in texts:
            match = re.fullmatch(r"([0-9.]+(?:e-?[0-9]+)?) ?(%|m)", word.strip())
            try:
                value = float(match[1]) if match else math.nan
            except ValueError:
                value = math.nan
            if not match or not 0 < value < math.inf:
                raise ValueError(
                    f"target error {word}: a positive number with its unit is needed, 0.1% for the detection or "
                    "0.02m for the radius"
                )
            name, error = ("radius_m", value) if match[2] == "m" else ("detection", value / 100)
            if name in errors:
                raise ValueError(f"target error {word}: another number in {match[2]} was given before; give one")
            errors[name] = error
        return cls(**errors) if errors else None


@dataclass(frozen=True)
class ConvergenceStatus:
    """Standard error of one number, compared with its target.

    Args:
        rig: Name of the rig, or `B minus A` for a difference.
        region: Name of the region.
        band: Name of the height band.
        quantity: Key of the quantity, as in the columns of `summary.csv`.
        error: Current standard error, in meters or as a share; NaN if there are not enough frames.
        target: Largest accepted standard error.
        num_frames: Frames so far.
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
        """True if the error is small enough, and from enough frames to be reliable."""
        return self.num_frames >= MIN_FRAMES and self.error <= self.target

    @property
    def excess(self) -> float:
        """Ratio of the error to its target; infinite if the error is unknown."""
        return math.inf if math.isnan(self.error) else self.error / self.target

    @property
    def frames_needed(self) -> int | None:
        """Expected number of frames for the target, as errors fall with 1 / sqrt(frames); None without an error."""
        if math.isinf(self.excess):
            return None
        if self.is_reached:
            return max(MIN_FRAMES, self.num_frames)
        model = ErrorModel.from_error(self.error, self.num_frames)
        return max(MIN_FRAMES, model.estimate_num_frames(self.target) or 0)

    @property
    def text(self) -> str:
        """Error and target in words."""
        return f"error {_format_error(self.error, self.quantity)} (target {_format_error(self.target, self.quantity)})"


def compute_convergence(
    target: TargetError, coverages: Mapping[str, Coverage], regions: Sequence[Region]
) -> list[ConvergenceStatus]:
    """Compare the standard error of every number with its target: of each rig, and of its difference to the first.

    Numbers of unobserved regions have no error and are left out.

    Args:
        target: Largest accepted standard errors.
        coverages: Name of each rig -> its coverage, all from the same frames.
        regions: Regions within the grid.

    Returns:
        One status for each rig or difference, region, height band and quantity with a target.
    """
    (first_name, first), *_ = coverages.items()
    statuses = []
    for region, band in list_region_bands(regions, first.grid):
        estimates = {name: coverage.estimate(region, band) for name, coverage in coverages.items()}
        for name in list(estimates):
            if name != first_name:
                estimates[f"{name} minus {first_name}"] = estimates[name].subtract(estimates[first_name])
        for name, estimate in estimates.items():
            values, errors = estimate.value.tolist(), estimate.error.tolist()
            for quantity, value, error in zip(first.quantities, values, errors, strict=True):
                target_value = target.radius_m if quantity.unit == "m" else target.detection
                if target_value is not None and not math.isnan(value):
                    location = (name, region.name, band, quantity.key)
                    statuses.append(ConvergenceStatus(*location, error, target_value, first.counts["num_frames"]))
    return statuses


@dataclass(frozen=True)
class StoppingParams:
    """Schedule of the checks of a target error.

    The rule checks when the errors should have become small enough, but not before the frames have grown by
    `min_growth`, and not after `max_growth`: a run may be longer than necessary by the distance of two checks.

    Args:
        num_confirmations: Consecutive checks that must be successful. An error that is too small by chance at one check
            would otherwise end the run.
        min_growth: Smallest ratio of the frames at two consecutive checks.
        max_growth: Largest ratio.
    """

    num_confirmations: int = 2
    min_growth: float = 1.04
    max_growth: float = 1.5


class TargetErrorRule:
    """Stopping rule of `observe` that ends a run once all standard errors reach their target.

    Args:
        target: Largest accepted standard errors.
        observers: Name of each rig -> its coverage observer.
        regions: Regions within their grid.
        params: Schedule of the checks.

    Attributes:
        next_check_frame: Number of frames at which the errors are checked next.
        worst: Status with the largest excess at the last check; None before the first check.
    """

    def __init__(
        self,
        target: TargetError,
        observers: Mapping[str, Observer[Coverage]],
        regions: Sequence[Region],
        params: StoppingParams = StoppingParams(),
    ) -> None:
        self.target = target
        self.observers = observers
        self.regions = regions
        self.next_check_frame = MIN_FRAMES
        self.worst: ConvergenceStatus | None = None
        self._params = params
        self._num_successful_checks = 0

    def is_reached(self, num_frames: int) -> bool:
        """Check the errors, if a check is due.

        Args:
            num_frames: Frames so far.

        Returns:
            Whether the run may end; False between two checks.
        """
        if num_frames < self.next_check_frame:
            return False
        coverages = {name: observer.compute() for name, observer in self.observers.items()}
        statuses = compute_convergence(self.target, coverages, self.regions)
        self.worst = max(statuses, key=attrgetter("excess"), default=None)
        is_successful = self.worst is not None and self.worst.is_reached
        self._num_successful_checks = self._num_successful_checks + 1 if is_successful else 0
        if self._num_successful_checks >= self._params.num_confirmations:
            return True
        frames_needed = math.inf if self.worst is None else self.worst.frames_needed or math.inf
        earliest, latest = self._params.min_growth * num_frames, self._params.max_growth * num_frames
        self.next_check_frame = math.ceil(min(max(frames_needed, earliest), latest))
        return False

    def state_dict(self) -> dict[str, Any]:
        """Return the schedule and the results of the last checks."""
        return {
            "next_check_frame": self.next_check_frame,
            "num_successful_checks": self._num_successful_checks,
            "worst": None if self.worst is None else asdict(self.worst),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from the state of another rule.

        Args:
            state_dict: Return value of its `state_dict`.
        """
        self.next_check_frame = state_dict["next_check_frame"]
        self._num_successful_checks = state_dict["num_successful_checks"]
        self.worst = None if state_dict["worst"] is None else ConvergenceStatus(**state_dict["worst"])

    def estimate_num_frames(self, max_frames: int) -> int:
        """Estimate the number of frames of the whole run.

        Args:
            max_frames: Upper limit, which is returned while nothing is known.
        """
        if self.worst is None or self.worst.frames_needed is None:
            return max_frames
        return min(max_frames, max(self.worst.frames_needed, self.next_check_frame))

    @property
    def progress_text(self) -> str:
        """Worst error and its target, for the progress bar."""
        return self.worst.text if self.worst else ""


def _format_error(error: float, quantity: str) -> str:
    """Format a standard error with its unit."""
    return f"{error:.2g} m" if quantity == "radius_m" else f"{100 * error:.2g} %"


def summarize_target_error(
    target: TargetError | None, coverages: Mapping[str, Coverage], regions: Sequence[Region], *, is_confirmed: bool
) -> tuple[dict[str, Any] | None, list[str]]:
    """Summarize at the end of a run whether the target errors were reached.

    Args:
        target: Largest accepted standard errors; None if there is no target.
        coverages: As in `compute_convergence`.
        regions: Regions within the grid.
        is_confirmed: Whether the rule ended the run.

    Returns:
        Record for `summary.json`, with errors in meters or as shares, and lines for the terminal.
    """
    if target is None:
        return None, []
    statuses, first = compute_convergence(target, coverages, regions), next(iter(coverages.values()))
    unobserved = [f"{row.region} {row.band}" for row in first.summary(regions) if not row.observed_cells]
    lines = _describe_convergence(statuses, first.counts["num_frames"], is_confirmed=is_confirmed)
    if unobserved:
        lines.append(f"Not part of the target, as none of its cells is observed: {', '.join(unobserved)}.")
    # A standard error of 0 is no evidence: it only means that all blocks have the same value.
    constant = [
        f"{item.region} {item.band}, {item.quantity} of {item.rig}" for item in statuses if item.error <= ROUND_OFF
    ]
    if constant:
        lines.append(f"Not part of the target, as all frames have the same value: {'; '.join(constant)}.")
    return {**_build_record(target, statuses), "reached": is_confirmed, "unobserved": unobserved}, lines


def _build_record(target: TargetError, statuses: Sequence[ConvergenceStatus]) -> dict[str, Any]:
    """Build the JSON record of all numbers with their errors and needed frames."""
    frames_needed, numbers = [], []
    for status in statuses:
        frames_needed.append(status.frames_needed)
        record = asdict(status)
        del record["num_frames"]
        record |= {"is_reached": status.is_reached, "frames_needed": status.frames_needed}
        numbers.append(to_json_record(record))
    known_frames = [num_frames for num_frames in frames_needed if num_frames is not None]
    all_known = bool(known_frames) and len(known_frames) == len(frames_needed)
    return {**asdict(target), "frames_needed": max(known_frames) if all_known else None, "numbers": numbers}


def _describe_convergence(statuses: Sequence[ConvergenceStatus], num_frames: int, *, is_confirmed: bool) -> list[str]:
    """Describe the success, or the worst number of each region and band with the frames that it needs."""
    if not statuses:
        return ["Target error not reached: no region has an observed cell."]
    if is_confirmed:
        return [f"Target error reached after {num_frames:,} frames."]
    outcome = f"Target error not reached in {num_frames:,} frame{'s' * (num_frames != 1)}"
    if all(status.is_reached for status in statuses):
        return [f"{outcome}: every error is small enough, but not yet at two consecutive checks; use more frames."]
    lines = [f"{outcome}; the largest error of each region:"]
    for (region, band), group in groupby(statuses, key=attrgetter("region", "band")):
        worst = max(group, key=attrgetter("excess"))
        location = f"  {region} {band}, {worst.quantity} of {worst.rig}"
        if worst.frames_needed is None:
            lines.append(f"{location}: not enough frames for an error")
        elif worst.is_reached:
            lines.append(f"{location}: {worst.text}, reached")
        else:
            advice = f"about {round_up_frames(worst.frames_needed):,} different frames are needed"
            lines.append(f"{location}: {worst.text}, {advice}")
    return lines


def round_up_frames(num_frames: int) -> int:
    """Round a number of frames up to two digits.

    Args:
        num_frames: Number of frames.

    Example:
        >>> round_up_frames(99), round_up_frames(1234)
        (99, 1300)
    """
    unit: int = 10 ** max(0, len(str(num_frames)) - 2)
    return -(-num_frames // unit) * unit
