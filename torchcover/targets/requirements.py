"""What a rig must see of a target, and whether it does."""

import math
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from torchcover.simulation.documents import Document, Readable
from torchcover.targets.result import SIDES, Place, TargetMap
from torchcover.targets.target import TARGETS

# What is judged of a map, where a mean would hide a step in which nothing is seen.
JUDGED = {"points": "least_points", "sensors": "least_sensors"}
# Of a mean over steps, what rounding makes of it.
ROUNDING = 1e-9


class Requirement(Document):
    """What must be seen everywhere within a distance of the vehicle.

    Args:
        target: What `--target` or a built-in body is called; any target if not given.
        within_m: Distance of the target's middle from the vehicle's box, seen from above.
        sides: On these sides only; on all if not given.
        points: Least number of points on it, in every step.
        sensors: Least number of sensors with enough points each, in every step.
        share: Least share of its visible surface within the threshold, over all steps.
        seen: Least share of the steps with enough points.

    Example:
        >>> Requirement(target="child", within_m=2, points=5).words
        'child within 2 m: points >= 5'
    """

    target: str | None = None
    within_m: PositiveFloat
    sides: tuple[Literal["front", "rear", "left", "right"], ...] | None = Field(default=None, min_length=1)
    points: NonNegativeFloat | None = None
    sensors: NonNegativeFloat | None = None
    share: Annotated[float, Field(ge=0.0, le=1.0)] | None = None
    seen: Annotated[float, Field(ge=0.0, le=1.0)] | None = None

    @model_validator(mode="after")
    def _check_names_something(self) -> Self:
        if not any(self.least.values()):
            raise ValueError("nothing is required: give points, sensors, share or seen, one of them above 0")
        return self

    @property
    def least(self) -> dict[str, float]:
        """What is required, by name."""
        given = {name: getattr(self, name) for name in ("points", "sensors", "share", "seen")}
        return {name: value for name, value in given.items() if value is not None}

    @property
    def words(self) -> str:
        """In one line."""
        where = f"within {self.within_m:g} m" + (f" {', '.join(self.sides)}" if self.sides else "")
        least = ", ".join(f"{name} >= {value:g}" for name, value in self.least.items())
        return f"{self.target or 'any target'} {where}: {least}"

    def is_about(self, target: str) -> bool:
        """Whether it asks about a target that has this name."""
        return self.target is None or target in (self.target, TARGETS.get(self.target))


class Requirements(Readable):
    """A list of them.

    Args:
        requirements: Each must be met for its target.
    """

    requirements: tuple[Requirement, ...] = Field(min_length=1)


class Verdict(NamedTuple):
    """Whether a requirement is met: of how many `cells`, how many fail, how many of them are unknown, the worst."""

    requirement: Requirement
    passed: bool
    cells: int
    failed: int
    unknown: int
    worst: tuple[Place, ...]


def check(requirements: Requirements, seen: TargetMap, *, tell: int = 5) -> list[Verdict]:
    """Judge every requirement about the target of a map.

    Every free cell in reach must have what is required; one whose value is unknown has not. Cells where the target
    cannot stand are left out.

    Args:
        requirements: What must be seen; those about other targets are left out.
        seen: What is seen.
        tell: How many of the failing places to name, the nearest first.

    Raises:
        ValueError: None of them is about this target, the raster ends before one of their distances, or no cell is free
            there.
    """
    about = [one for one in requirements.requirements if one.is_about(seen.target)]
    if not about:
        others = ", ".join(sorted({str(one.target) for one in requirements.requirements}))
        raise ValueError(f"no requirement is about the target {seen.target!r}; they are about {others}")
    return [_judged(one, seen, tell) for one in about]


def _judged(requirement: Requirement, seen: TargetMap, tell: int) -> Verdict:
    _check_reach(requirement, seen)
    side = np.isin(seen.side, [-1, *(SIDES.index(name) for name in requirement.sides or SIDES)])
    there = seen.free & side & (seen.distance_m <= requirement.within_m)
    if not there.any():
        raise ValueError(
            f"requirement {requirement.words!r}: there is no free cell, so it says nothing; take a smaller step of the "
            "raster or a larger distance"
        )
    values = {name: getattr(seen, JUDGED.get(name, name)) for name in requirement.least}
    unknown = there & np.any([np.isnan(array) for array in values.values()], axis=0)
    met = [values[name] >= least - ROUNDING for name, least in requirement.least.items()]  # NaN is not
    row, column = np.nonzero(there & ~np.all(met, axis=0))
    nearest = np.argsort(seen.distance_m[row, column], kind="stable")[:tell]
    worst = tuple(seen.place(int(row[at]), int(column[at])) for at in nearest)
    return Verdict(requirement, len(row) == 0, int(there.sum()), len(row), int(unknown.sum()), worst)


def _check_reach(requirement: Requirement, seen: TargetMap) -> None:
    """A raster that ends too early, or begins too late, would let pass what was never looked at."""
    (x0, y0, _), (x1, y1, _) = seen.vehicle.lower_m, seen.vehicle.upper_m
    raster, within_m = seen.raster, requirement.within_m
    # A side ends where it is as far aside as ahead.
    aside_m = within_m / math.sqrt(2)
    low_x, high_x, low_y, high_y = x0 - aside_m, x1 + aside_m, y0 - aside_m, y1 + aside_m
    areas = {
        "front": ((x1, x1 + within_m), (low_y, high_y)),
        "rear": ((x0 - within_m, x0), (low_y, high_y)),
        "left": ((low_x, high_x), (y1, y1 + within_m)),
        "right": ((low_x, high_x), (y0 - within_m, y0)),
    }
    for name in requirement.sides or SIDES:
        for axis, (low_m, high_m), ours_m in zip("xy", areas[name], (raster.x, raster.y), strict=True):
            if ours_m[0] > low_m + ROUNDING or ours_m[1] < high_m - ROUNDING:
                raise ValueError(
                    f"requirement {requirement.words!r}: the {name} within {within_m:g} m spans {axis} = {low_m:.4g} "
                    f"to {high_m:.4g} m, and the raster {ours_m[0]:g} to {ours_m[1]:g} m; take a larger one"
                )
