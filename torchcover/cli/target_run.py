"""Implementation of `torchcover targets`."""

import math
import warnings
from pathlib import Path
from typing import Any

from torchcover.cli.printing import print_files, print_verdict
from torchcover.evaluation import map_target_visibility, save_target_map
from torchcover.evaluation.target_page import build_positions_table, build_sides_table, summarize_target_maps
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
    """Map the visibility of a target, save the map and print a summary.

    Args:
        rig: Built-in name or YAML file.
        target: Built-in name or file.
        scenario: Built-in name or YAML file; None: flat ground.
        raster: Text for `parse_raster`; None: the default positions.
        heading: Text for `parse_heading`.
        out: Folder of the results.
        file_kinds: Files in addition to `summary.json`.
        settings: Further arguments of `map_target_visibility`.

    Raises:
        ValueError: Invalid option or file.
        FileNotFoundError: Unknown name or file.
    """
    with lock_folder(out):
        target_map = map_target_visibility(
            rig,
            target,
            scenario,
            raster=None if raster is None else parse_raster(raster),
            heading=parse_heading(heading),
            **settings,
        )
        written = save_target_map(target_map, out, Rig.load(rig).sensors, file_kinds=file_kinds)
    _print_map(target_map)
    print_files(written, out, Terminal())
    print_verdict(summarize_target_maps({target_map.rig: target_map}), Terminal())


def parse_raster(text: str) -> Raster:
    """Parse a raster of positions; a side that is no multiple of the spacing becomes longer, with a warning.

    Args:
        text: `x0,x1,y0,y1,spacing` in meters.

    Returns:
        The raster.

    Raises:
        ValueError: Not five numbers, or as in `Raster`.

    Example:
        >>> parse_raster("-4,4,-3,3,0.5").shape
        (12, 16)
    """
    try:
        x0, x1, y0, y1, spacing_m = (float(number) for number in text.split(","))
    except ValueError as error:
        raise ValueError(
            f"--raster: x0,x1,y0,y1,spacing in meters is needed, as in -8,8,-5,5,0.2; got {text!r}"
        ) from error
    if 0 < spacing_m < math.inf and math.isfinite(x0 + x1 + y0 + y1):
        # The tolerance keeps a side that is a multiple of the spacing except for rounding.
        end_x = x0 + spacing_m * math.ceil((x1 - x0) / spacing_m - 1e-6)
        end_y = y0 + spacing_m * math.ceil((y1 - y0) / spacing_m - 1e-6)
        if max(abs(end_x - x1), abs(end_y - y1)) > 1e-6:
            warnings.warn(
                f"--raster {text}: the sides are no multiples of the spacing; the raster ends at x = {end_x:g} and "
                f"y = {end_y:g} m instead",
                stacklevel=2,
            )
            x1, y1 = end_x, end_y
    return Raster((x0, x1), (y0, y1), spacing_m)


def parse_heading(text: str) -> Heading:
    """Parse the heading of a target.

    Args:
        text: `narrow`, `wide`, or a yaw in degrees.

    Raises:
        ValueError: Another text.
    """
    if text in ("narrow", "wide"):
        return text  # type: ignore[return-value]  # one of the two literals
    try:
        return float(text)
    except ValueError as error:
        raise ValueError(f"--heading: narrow, wide or degrees are needed; got {text!r}") from error


def _print_map(target_map: TargetMap) -> None:
    """Print the tables of a map."""
    console = Terminal()
    console.print(
        f"{target_map.rig}: visibility of {target_map.target} ({target_map.target_description}) in "
        f"{target_map.scenario}, sensor model {target_map.sensor_model}",
        markup=False,
        soft_wrap=True,
    )
    worst = build_positions_table(
        target_map.find_worst_positions(), "Positions with the fewest points, at least 1 m from each other"
    )
    print_page_tables([build_sides_table(target_map), worst])
    if num_unobserved := target_map.counts["surface_share_unobserved"]:
        console.print(
            f"Surface share unknown at {num_unobserved:,} positions: the reference observed no surface of the target."
        )
