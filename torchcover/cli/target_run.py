"""What `torchcover targets` does and prints."""

import math
import warnings
from pathlib import Path
from typing import Any

from torchcover.cli.printing import print_files, print_verdict
from torchcover.evaluation import map_target_visibility, save_target_map
from torchcover.evaluation.target_visibility import build_positions_table, build_sides_table, summarize_target_maps
from torchcover.files import lock_folder
from torchcover.report import Terminal, print_page_tables
from torchcover.simulation import Rig
from torchcover.targets import Heading, Raster, TargetMap


def run_targets_command(
    rig: str,
    target: str,
    scenario: str | None,
    *,
    raster: str | None,
    heading: str,
    out: Path,
    file_kinds: str,
    **settings: Any,  # noqa: ANN401  (those of `map_target_visibility`)
) -> None:
    """Survey a target, write and print what is seen.

    Raises:
        ValueError: An option or a file that cannot be used.
        FileNotFoundError: An unknown name or file.
    """
    with lock_folder(out):
        seen = map_target_visibility(
            rig,
            target,
            scenario,
            raster=None if raster is None else parse_raster(raster),
            heading=parse_heading(heading),
            **settings,
        )
        written = save_target_map(seen, out, Rig.load(rig).sensors, file_kinds=file_kinds)
    _print(seen)
    print_files(written, out, Terminal())
    print_verdict(summarize_target_maps({seen.rig: seen}), Terminal())


def parse_raster(text: str) -> Raster:
    """The raster of `x0,x1,y0,y1,step`, in metres; up to a step larger, with a warning, if the step does not divide it.

    Raises:
        ValueError: Other than five numbers, or what `Raster` refuses.

    Example:
        >>> parse_raster("-4,4,-3,3,0.5").shape
        (12, 16)
    """
    try:
        x0, x1, y0, y1, step_m = map(float, text.split(","))
    except ValueError as error:
        raise ValueError(f"--raster: x0,x1,y0,y1,step in metres, as in -8,8,-5,5,0.2; got {text!r}") from error
    if 0 < step_m < math.inf and math.isfinite(x0 + x1 + y0 + y1):
        most_x, most_y = (low + step_m * math.ceil((high - low) / step_m - 1e-6) for low, high in ((x0, x1), (y0, y1)))
        if max(abs(most_x - x1), abs(most_y - y1)) > 1e-6:
            told = f"--raster {text}: no whole number of steps; it ends at x {most_x:g} and y {most_y:g} m instead"
            warnings.warn(told, stacklevel=2)
            x1, y1 = most_x, most_y
    return Raster((x0, x1), (y0, y1), step_m)


def parse_heading(text: str) -> Heading:
    """`narrow`, `wide`, or degrees.

    Raises:
        ValueError: Anything else.
    """
    if text in ("narrow", "wide"):
        return text  # type: ignore[return-value]  # one of the two literals
    try:
        return float(text)
    except ValueError as error:
        raise ValueError(f"--heading: narrow, wide or degrees are needed; got {text!r}") from error


def _print(seen: TargetMap) -> None:
    console = Terminal()
    console.print(
        f"{seen.rig} sees {seen.target} ({seen.target_description}), in {seen.scenario}, sensor model {seen.sensor_model}",
        markup=False,
        soft_wrap=True,
    )
    worst = build_positions_table(seen.find_worst_positions(), "The places with the fewest points, 1 m apart")
    print_page_tables([build_sides_table(seen), worst])
    if unknown := seen.counts["surface_share_unobserved"]:
        console.print(f"{unknown:,} places show no surface to any random place: their share is unknown.")
