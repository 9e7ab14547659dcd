"""Plan and trials of a study of error against run time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from torchcover.coverage.grid import BandFrame
from torchcover.estimation import Difference, ErrorModel, Quantity
from torchcover.evaluation.config import STUDY_SETTINGS
from torchcover.evaluation.settings import Settings
from torchcover.evaluation.target_error import round_up_frames


@dataclass(frozen=True)
class StudyParams:
    """Parameters of a study.

    Args:
        num_frames: Frames of the baseline if the settings do not define them.
        target_errors: Standard errors of the detection rates for which a setting is recommended.
        variant_share: Variants are evaluated on this share of the blocks of the baseline, from the first on.
        min_saving: A variant is recommended instead of the baseline only if it saves more than this share of the time.
        significance_level: A difference is a bias if its p-value, times the number of comparisons, is smaller.
        num_doublings: The diagram shows run times for this number of doublings of the frames.
    """

    num_frames: int = 512
    target_errors: tuple[float, ...] = (0.02, 0.01, 0.005)
    variant_share: float = 0.25
    min_saving: float = 0.2
    significance_level: float = 0.05
    num_doublings: int = 6


@dataclass(frozen=True)
class StudyPlan:
    """Settings to compare on the same frames.

    Args:
        settings: Baseline: settings of `evaluate` with one rig and one scenario, by names or paths; 512 frames by
            default.
        variants: Changes of the baseline: name of an argument of `evaluate` -> value.
        params: Parameters of the study.

    Raises:
        ValueError: Not one rig and one scenario, by names or paths.
    """

    settings: Settings
    variants: tuple[Mapping[str, Any], ...] = (
        {"num_rays": 4096},
        {"only_detection": True},
        {"only_detection": True, "num_rays": 512},
    )
    params: StudyParams = StudyParams()

    def __post_init__(self) -> None:
        are_names = all(isinstance(name, str | Path) for name in self.input_names)
        if not are_names or len(self.settings.rigs) != 1:
            raise ValueError(
                "study: one rig and a scenario are needed, by names or paths, because their command is timed"
            )

    @property
    def input_names(self) -> tuple[Any, ...]:
        """Rig and scenario as the user gave them."""
        return (*self.settings.rigs, self.settings.single_scenario)

    @property
    def trial_settings(self) -> dict[str, Settings]:
        """Options of every trial -> its settings; the baseline is first and has no options."""
        # Scenes are built again, because later runs of the user have other scenes, and building them takes time.
        num_frames = self.settings.num_frames or self.params.num_frames
        baseline = replace(self.settings, num_frames=num_frames, no_cache=True)
        trials = {"": baseline}
        for variant in self.variants:
            trials[" ".join(_format_options(variant))] = replace(baseline, **variant)
        return trials

    @property
    def command(self) -> list[str]:
        """Arguments of `torchcover` for the baseline: command, rig, and options that differ from their defaults."""
        defaults = Settings()
        changed = {}
        for name in STUDY_SETTINGS:
            value = getattr(self.settings, name)
            if value != getattr(defaults, name):
                changed[name] = value
        return ["evaluate", str(self.input_names[0]), *_format_options(changed)]


def _format_options(settings: Mapping[str, Any]) -> list[str]:
    """Format settings as options `--set KEY=VALUE`."""
    words = []
    for name, value in settings.items():
        text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        words += ["--set", f"{name}={text.lower() if isinstance(value, bool) else text}"]
    return words


class StudiedNumber(NamedTuple):
    """Coverage number of one trial.

    Args:
        region: Name of the region.
        band: Name of the height band.
        has_target: True if `--target-error` applies to the region.
        quantity: Quantity of the number.
        value: The number.
        error: Its error as a function of the number of frames.
        difference: Difference to the baseline on the same frames; None for the baseline.
        is_biased: True if the difference is significant.
    """

    region: str
    band: str
    has_target: bool
    quantity: Quantity
    value: float
    error: ErrorModel
    difference: Difference | None
    is_biased: bool


@dataclass(frozen=True)
class Trial:
    """Run time and numbers of one setting.

    Args:
        options: Changes of the baseline as options of the command line; empty for the baseline.
        num_frames: Evaluated frames.
        min_frames: Fewest frames that give a standard error of all numbers with a target.
        duration_s: Run time of these frames.
        cpu_s: CPU time of these frames, including workers.
        band_frame: Origin of the height bands.
        numbers: Numbers of all regions and bands.
    """

    options: str
    num_frames: int
    min_frames: int
    duration_s: float
    cpu_s: float
    band_frame: BandFrame
    numbers: Sequence[StudiedNumber]

    def select_numbers(self, unit: str) -> list[StudiedNumber]:
        """Select the numbers with a target and a unit, without unobserved ones.

        Args:
            unit: Unit of the quantity, such as `share` or `m`.
        """
        selected = []
        for number in self.numbers:
            if number.has_target and number.quantity.unit == unit and not math.isnan(number.value):
                selected.append(number)
        return selected

    def estimate_error(self, num_frames: int, unit: str) -> float:
        """Estimate the largest error of the numbers with a unit.

        Args:
            num_frames: Number of frames.
            unit: Unit of the quantity.

        Returns:
            The error in the unit; NaN if the error of one of the numbers is unknown, or without numbers.
        """
        errors = [number.error.estimate_error(num_frames) for number in self.select_numbers(unit)]
        has_unknown = any(math.isnan(error) for error in errors)
        return math.nan if has_unknown else max(errors, default=math.nan)

    def estimate_num_frames(self, error: float) -> int | None:
        """Estimate the frames after which all detection rates have an error, rounded up to two digits.

        Args:
            error: Standard error as a share.

        Returns:
            The number of frames; None if a bias exceeds the error or an error is unknown.
        """
        needed = [self.min_frames]
        numbers = self.select_numbers("share")
        for number in numbers:
            num_frames = number.error.estimate_num_frames(error)
            if num_frames is None:
                return None
            needed.append(num_frames)
        return round_up_frames(max(needed)) if numbers else None

    def estimate_duration_s(self, num_frames: int, startup_s: float) -> float:
        """Estimate the run time of a command.

        Args:
            num_frames: Number of frames.
            startup_s: Run time without frames.
        """
        return startup_s + self.duration_s * num_frames / self.num_frames
