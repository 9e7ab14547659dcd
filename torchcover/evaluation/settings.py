"""What an evaluation is done with, unless the user says otherwise."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import partial
from numbers import Real
from pathlib import Path
from typing import Any, Self, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchcover.coverage import Aggregation, CoverageMetric, Measure
from torchcover.evaluation.target_error import AnyTargetError, TargetError
from torchcover.simulation import Asked, RegionsOfInterest, Scenario
from torchcover.simulation.memory import check_fits

DEFAULT_SCENARIO = "courtyard"
DEFAULT_STEPS = 64
# With a target error; as many as the paper averages.
MAX_STEPS = 4096
# Steps that follow each other are alike (docs/measured/error_bars.md), and every minute is another city.
EVERY_S_IN_TRAFFIC = 10.0
# For standard errors: at least half as many are in use at the end of a long run.
BLOCKS = 16
# Beside its sums a metric makes a result of them, at most as large.
STATE_COPIES = 2
# A process with torch and the geometry of a small scenario.
BYTES_PER_WORKER = 300e6
TOO_MANY_CELLS = "use larger cells, or a smaller grid"

AnyAsk = RegionsOfInterest | str | Path
AnyMetrics = str | Iterable[str]
AnyThresholds = float | Iterable[float]
AnyDevice = str | torch.device


@dataclass(frozen=True)
class Settings:
    """What `evaluate` and `compare` let the user set, see there; None where the user gave nothing.

    Raises:
        ValueError: A number of steps below 1, an unknown measure, more workers than the memory has room for.
    """

    steps: int | None = None
    seed: int = 0
    vehicle: str | None = None
    ask: RegionsOfInterest | None = None
    cell_m: float | None = None
    thresholds: tuple[float, ...] = (0.4,)
    aggregations: tuple[Aggregation, ...] = ()
    reference_sensor: str | None = None
    rays: int | None = None
    estimate: Measure | None = None
    every_s: float | None = None
    target_error: TargetError | None = None
    redundancy: bool = False
    metrics: tuple[str, ...] = ()
    device: str = "cpu"
    workers: int = 0
    skip_bad_frames: bool = False

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise ValueError(f"steps: at least 1 is needed; got {self.steps}")
        check_fits(f"{self.workers:,} workers", BYTES_PER_WORKER * self.workers, "use fewer")
        if self.estimate not in (None, *get_args(Measure)):
            raise ValueError(f"estimate {self.estimate}: `area` or `known` is needed")

    @classmethod
    def among(cls, arguments: Mapping[str, Any]) -> Self:
        """The settings among the arguments of a call, in the one form that they have from here on.

        Raises:
            ValueError: One that makes no sense.
            TypeError: One of a wrong kind.
        """
        given = {field.name: arguments[field.name] for field in fields(cls)}
        given["thresholds"] = _thresholds(given["thresholds"])
        given["aggregations"] = _aggregations(given["aggregations"])
        given["target_error"] = _target(given["target_error"])
        given["ask"] = _asked(given["ask"])
        given["metrics"] = _metrics(given["metrics"])
        given["device"] = str(given["device"])
        given["vehicle"] = given["vehicle"] and str(given["vehicle"])
        return cls(**given)

    @property
    def simulated_steps(self) -> int:
        """Steps of a simulation, at most."""
        if self.steps is not None:
            return self.steps
        return DEFAULT_STEPS if self.target_error is None else MAX_STEPS

    @property
    def needs_boxes(self) -> bool:
        """Whether a metric is about objects, so that frames are to have them."""
        if not self.metrics:
            return False
        from torchcover.published import PUBLISHED

        return any("boxes" in PUBLISHED[name].needs for name in self.metrics)

    def asked(self, ego_outline_m: NDArray[np.float64] | None) -> Asked:
        """Regions, height bands and grid for one vehicle.

        Args:
            ego_outline_m: (K, 2) its corners x, y; None if nobody knows.

        Raises:
            ValueError: As `RegionsOfInterest.around`.
        """
        return (self.ask or RegionsOfInterest()).around(ego_outline_m, self.cell_m)

    def check_recording(self) -> None:
        """Find out whether anything was set that a recording decides itself.

        Raises:
            ValueError: The vehicle, the reference sensor, its rays or the time between steps was set.
        """
        if self.vehicle is not None:
            raise ValueError("vehicle: for simulations; a recording has its own")
        if any(setting is not None for setting in (self.reference_sensor, self.rays, self.every_s)):
            raise ValueError("reference, rays and every are for simulations; a recording has its reference points")

    def metric(self, asked: Asked, sensors: Sequence[str] = (), *, square_metres: bool) -> CoverageMetric:
        """An empty metric.

        Args:
            asked: What is asked about.
            sensors: Names of the sensors, for redundancy.
            square_metres: Whether the frames have the square metres of reference points.

        Raises:
            ValueError: An estimate by area is wanted, and there are no square metres; a device that cannot be used; as
                `new_metric`.
        """
        if self.estimate == "area" and not square_metres:
            raise ValueError(
                "estimate area: it needs the square metres of reference points, which the surface reference of a "
                "simulation gives; leave it out for means over the known cells"
            )
        return new_metric(
            asked,
            self.thresholds,
            usable_device(self.device),
            aggregations=self.aggregations,
            sensors=sensors,
            square_metres=square_metres and self.estimate != "known",
        )


def usable_device(name: str) -> torch.device:
    """The device of this name.

    Raises:
        ValueError: It cannot be used here.
    """
    try:
        device = torch.device(name)
        torch.zeros(1, device=device, dtype=torch.float64).item()  # the device `meta` has no values
    except (RuntimeError, AssertionError, TypeError, ImportError) as error:
        said = str(error).splitlines()[0].partition(". ")[0]  # some go on for pages
        raise ValueError(f"device {name}: cannot be used here ({said}); try cpu") from error
    return device


def new_metric(
    asked: Asked,
    thresholds: tuple[float, ...],
    device: torch.device,
    *,
    blocks: int = BLOCKS,
    aggregations: Sequence[Aggregation] = (),
    sensors: Sequence[str] = (),
    square_metres: bool = False,
) -> CoverageMetric:
    """An empty metric of what is asked about, with standard errors unless there is one block only.

    Raises:
        ValueError: A threshold that makes no sense, or more cells than there is memory for.
    """
    grid = asked.grid
    build = partial(
        CoverageMetric,
        grid,
        thresholds,
        max_radius=grid.diagonal_m,
        blocks=blocks,
        aggregations=aggregations,
        regions=asked.regions,
        sensors=sensors,
        square_metres=square_metres,
        sync_on_compute=False,  # within a process group of the caller's, whose other processes know of no such metric
    )
    try:
        with torch.device("meta"):  # where tensors have a size and take no memory
            need = STATE_COPIES * sum(
                state.nbytes for state in build().metric_state.values() if isinstance(state, Tensor)
            )
        check_fits(f"the sums of {grid.cells:,} cells in {blocks} blocks", need, TOO_MANY_CELLS)
        return build().to(device)
    except RuntimeError as error:  # what torch raises when there is no memory left on the device
        raise ValueError(
            f"a cell of {grid.cell:g} m: there is not enough memory for the sums of {grid.cells:,} cells in {blocks} "
            f"blocks; {TOO_MANY_CELLS}"
        ) from error


def spread_s(scenario: Scenario, given_s: float | None) -> float:
    """Time between two steps: what was given, else 10 s in traffic, else what spreads the steps over the scenario.

    That is the golden share of its instants, round and round: any number of steps lies evenly over all of it, and no
    instant comes again before all have been seen.

    Example:
        >>> drive = {"name": "drive", "ego": {"shape": {"type": "box", "size_m": [4, 2, 2]}, "trajectory": "drive.csv"}}
        >>> ground = {"bodies": [{"name": "ground", "shape": {"type": "plane", "size_m": [99, 99]}}], "duration_s": 30}
        >>> every_s = spread_s(Scenario.model_validate({**drive, **ground}), None)
        >>> [round(step * every_s % 30.1, 1) for step in range(6)]
        [0.0, 18.6, 7.1, 25.7, 14.2, 2.7]
    """
    if given_s is not None:
        return given_s
    if scenario.instants is None:
        return EVERY_S_IN_TRAFFIC
    share = (math.sqrt(5) - 1) / 2 * scenario.instants
    each_once = (steps for steps in range(1, scenario.instants + 1) if math.gcd(steps, scenario.instants) == 1)
    return min(each_once, key=lambda steps: abs(steps - share)) * scenario.step_s


def _thresholds(given: Any) -> tuple[float, ...]:  # noqa: ANN401  (whatever the user gave)
    each = tuple(given) if isinstance(given, Iterable) else (given,)
    if not all(isinstance(threshold, Real) for threshold in each):
        raise TypeError(f"thresholds: metres are needed, as in 0.4 or (0.4, 1.0); got {given!r}")
    return tuple(float(threshold) for threshold in each)


def _aggregations(given: Any) -> tuple[Aggregation, ...]:  # noqa: ANN401
    if not isinstance(given, Sequence):  # what is in it the metric checks
        raise TypeError(f"aggregations: a sequence of objects such as [Maximum()] is needed; got {given!r}")
    return tuple(given)


def _metrics(given: AnyMetrics) -> tuple[str, ...]:
    if not given:
        return ()
    from torchcover.published import metric_names  # not needed by most runs

    return metric_names(given)


def _asked(given: AnyAsk | None) -> RegionsOfInterest | None:
    if given is None or isinstance(given, RegionsOfInterest):
        return given
    if not isinstance(given, str | Path):
        raise TypeError(f"ask: RegionsOfInterest(...) or the path of a YAML file is needed; got {given!r}")
    return RegionsOfInterest.load(given)


def _target(given: AnyTargetError | None) -> TargetError | None:
    return given if given is None or isinstance(given, TargetError) else TargetError.parse(given)
