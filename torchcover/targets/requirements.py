"""What a rig must see of a target, and whether it does."""

from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat, model_validator

from torchcover.simulation.documents import Document, read_document
from torchcover.targets.result import SIDES, Place, TargetMap
from torchcover.targets.target import TARGETS

# Of a mean over steps, what rounding makes of it.
ROUNDING = 1e-9


class Requirement(Document):
    """What must be seen everywhere within a distance of the vehicle.

    Args:
        target: What `--target` or a built-in body is called; any target if not given.
        within_m: Distance of the target's middle from the vehicle's box, seen from above.
        sides: On these sides only; on all if not given.
        points: Least number of points on it.
        sensors: Least number of sensors with enough points each.
        share: Least share of its visible surface within the threshold.
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
        if not self.least:
            raise ValueError("nothing is required: give points, sensors, share or seen")
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


class Requirements(Document):
    """A list of them.

    Args:
        requirements: Each must be met for its target.
    """

    requirements: tuple[Requirement, ...] = Field(min_length=1)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read them from a YAML file.

        Raises:
            FileNotFoundError: No such file.
            BadFileError: Not such a document; the message names the file and the key.
        """
        return read_document(cls, Path(path))


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
    values = {name: getattr(seen, name) for name in requirement.least}
    unknown = there & np.any([np.isnan(array) for array in values.values()], axis=0)
    met = [values[name] >= least - ROUNDING for name, least in requirement.least.items()]  # NaN is not
    row, column = np.nonzero(there & ~np.all(met, axis=0))
    nearest = np.argsort(seen.distance_m[row, column], kind="stable")[:tell]
    worst = tuple(seen.place(int(row[at]), int(column[at])) for at in nearest)
    return Verdict(requirement, len(row) == 0, int(there.sum()), len(row), int(unknown.sum()), worst)


def _check_reach(requirement: Requirement, seen: TargetMap) -> None:
    """A raster that ends too early would let pass what was never looked at."""
    (x0, y0, _), (x1, y1, _) = seen.vehicle.lower_m, seen.vehicle.upper_m
    raster = seen.raster
    reach_m = {"front": raster.x[1] - x1, "rear": x0 - raster.x[0], "left": raster.y[1] - y1, "right": y0 - raster.y[0]}
    for name in requirement.sides or SIDES:
        if reach_m[name] < requirement.within_m - ROUNDING:
            raise ValueError(
                f"requirement {requirement.words!r}: the raster ends {max(reach_m[name], 0.0):.3g} m from the vehicle "
                f"({name}); take a larger one"
            )
