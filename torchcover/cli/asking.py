"""What a command line asks about: regions, height bands and the grid."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torchcover.simulation import RegionsOfInterest


def asked(
    file: Path | None, regions: Sequence[str] | None, heights: Sequence[str] | None, grid: str | None
) -> "RegionsOfInterest | None":
    """What is asked about; None if nothing is said of it.

    Args:
        file: YAML; what options give replaces what it says.
        regions: NAME:x0,x1,y0,y1 each.
        heights: NAME:z0,z1 each.
        grid: x0,x1,y0,y1.

    Raises:
        FileNotFoundError: No such file.
        ValueError: What cannot be read, or makes no sense; a name that is given twice.
    """
    if file is None and not (regions or heights or grid):
        return None
    from pydantic import ValidationError

    from torchcover.simulation import RegionsOfInterest
    from torchcover.simulation.documents import explain

    content = {} if file is None else RegionsOfInterest.load(file).model_dump(exclude_unset=True)
    if regions:
        sides = _named("--region", regions, ("x0", "x1", "y0", "y1"))
        content["regions"] = {name: {"x_m": side[:2], "y_m": side[2:]} for name, side in sides.items()}
    if heights:
        content["heights"] = _named("--height", heights, ("z0", "z1"))
    if grid:
        side = _numbers("--grid", grid, grid, ("x0", "x1", "y0", "y1"))
        content["grid"] = {**content.get("grid", {}), "x_m": side[:2], "y_m": side[2:]}
    try:
        return RegionsOfInterest.model_validate(content)
    except ValidationError as error:
        raise ValueError(explain(error)) from error


def _named(option: str, given: Sequence[str], bounds: Sequence[str]) -> dict[str, tuple[float, ...]]:
    found: dict[str, tuple[float, ...]] = {}
    for text in given:
        name, colon, numbers = text.rpartition(":")
        if not (colon and name):
            raise ValueError(f"{option} {text}: NAME:{','.join(bounds)} is needed, in metres")
        if name in found:
            raise ValueError(f"{option} {text}: the name {name!r} is given already; choose another")
        found[name] = _numbers(option, text, numbers, bounds)
    return found


def _numbers(option: str, text: str, numbers: str, bounds: Sequence[str]) -> tuple[float, ...]:
    try:
        found = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        found = ()
    if len(found) != len(bounds):
        raise ValueError(f"{option} {text}: {len(bounds)} numbers {','.join(bounds)} in metres are needed")
    return found
