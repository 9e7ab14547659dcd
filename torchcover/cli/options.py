"""The options that several commands share."""

import os
from pathlib import Path
from typing import Annotated, Literal

import typer


def check_out(folder: Path) -> Path:
    """Find out before the run, not after it, whether its results can be written.

    Raises:
        ValueError: The folder, or the first of its parents that exists, is a file, a link to nothing, or may not be
            written to.
    """
    nearest = next(place for place in (folder, *folder.absolute().parents) if os.path.lexists(place))
    if not nearest.exists():
        raise ValueError(f"--out {folder}: {nearest} is a link to what is not there")
    if not nearest.is_dir():
        raise ValueError(f"--out {folder}: {nearest} is a file, not a folder")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"--out {folder}: {nearest} may not be written to; choose another folder")
    return folder


RigOrNone = Annotated[
    str | None, typer.Argument(help="Rig: a built-in name (see `list`) or a YAML file. Optional with --frames.")
]
Rig = Annotated[str, typer.Argument(help="Rig: a built-in name (see `list`) or a YAML file.")]
Rigs = Annotated[
    list[str] | None,
    typer.Argument(
        help="Rigs: built-in names (see `list`) or YAML files, two or more; with --frames those in it. Or coverage.npz "
        "files of runs over the same frames."
    ),
]
ScenarioOrNone = Annotated[str | None, typer.Option(help="Scenario: a built-in name or a YAML file (courtyard).")]
Frames = Annotated[
    Path | None,
    typer.Option(help="A recording instead of a simulation, of any layout in docs/recordings.md."),
]
RecordingFrames = Annotated[Path, typer.Option("--frames", help="The recording, of any layout in docs/recordings.md.")]
Format = Annotated[str | None, typer.Option("--format", help="Format of the recording, if it is not recognised.")]
Sensors = Annotated[
    list[str] | None,
    typer.Option(
        help="With --frames: sensors of a rig, as in `roof,left`; once for each rig. Not given: those of the recording."
    ),
]
SensorsOfRig = Annotated[
    list[str] | None, typer.Option("--sensors", help="Its sensors, as in `roof,left`. Not given: all of the recording.")
]
Window = Annotated[
    float | None,
    typer.Option(help="Seconds over which `--reference accumulated` adds up what all sensors saw (2)."),
]
Steps = Annotated[
    int | None, typer.Option(min=1, help="Steps to simulate (64), or most frames of a recording to use (all).")
]
RecordedSteps = Annotated[int | None, typer.Option(min=1, help="Steps to simulate (64), a frame each.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the simulation.")]
Vehicle = Annotated[
    str | None,
    typer.Option(
        help="What carries the rig: a built-in vehicle, a YAML file or a mesh in metres. Not given: the scenario's own "
        "ego, else the vehicle that the rig names, else an SUV."
    ),
]
Out = Annotated[Path, typer.Option(help="Folder for the results.", callback=check_out)]
RecordingOut = Annotated[
    Path, typer.Option("--out", help="Folder for the recording, new or empty.", callback=check_out)
]
Layout = Annotated[
    str, typer.Option("--format", help="`folder`, or `kitti`: KITTI's object layout, of a rig of one LiDAR.")
]
Regions = Annotated[
    list[str] | None,
    typer.Option(
        "--region",
        help="Region NAME:x0,x1,y0,y1 in metres, forward and to the left; may be repeated. Not given: the paper's in "
        "front, and the near field on the four sides of the vehicle.",
    ),
]
Heights = Annotated[
    list[str] | None,
    typer.Option("--height", help="Height band NAME:z0,z1 in metres; may be repeated, and overlap (ground, obstacle)."),
]
Grid = Annotated[
    str | None, typer.Option(help="Extent x0,x1,y0,y1 of the grid in metres (-40,160,-40,40, more if regions need it).")
]
Ask = Annotated[
    Path | None, typer.Option(help="The same, and polygons, in a YAML file; an option replaces what it says.")
]
Cell = Annotated[float | None, typer.Option(help="Side of a grid cell in metres (0.25).")]
Thresholds = Annotated[
    list[float] | None, typer.Option("--threshold", help="Detection threshold in metres (0.4); may be repeated.")
]
Reference = Annotated[
    str | None,
    typer.Option(
        help="Reference sensor: `surface`, points drawn evenly on what can be seen (default); `even`, rays spread over "
        "the regions and the grid; or `paper`. With --frames: `recorded`, or `accumulated` from the recording itself."
    ),
]
RecordedReference = Annotated[
    str | None,
    typer.Option(
        help="Reference sensor that is recorded too: `surface` (default), `even` or `paper`, as of `evaluate`."
    ),
]
Rays = Annotated[
    int | None,
    typer.Option(
        min=1,
        help="Rays of the reference sensor at each step (surface: 16384; even: 262144; paper: 1048576, a square).",
    ),
]
Estimate = Annotated[
    Literal["area", "known"] | None,
    typer.Option(
        help="What the number of a region is a mean over: `area`, its visible surface (default; needs `surface`), or "
        "`known`, its known cells, as in the paper."
    ),
]
Every = Annotated[
    float | None,
    typer.Option(
        help="Seconds between one step and the next; steps that follow each other are alike. Not given: 10 in traffic, "
        "which starts anew in another city every minute, else what spreads the steps over the scenario."
    ),
]
TargetErrors = Annotated[
    list[str] | None,
    typer.Option(
        "--target-error",
        help="Stop once every number (of the usual regions, those in front) is this good: 0.1% (standard error of each "
        "detection, in percentage points) or 0.02m (of each radius); both may be given. --steps is then the most steps "
        "(4096).",
    ),
]
Redundancy = Annotated[
    bool,
    typer.Option("--redundancy", help="Say by how many sensors places are seen, and what is lost when each one fails."),
]
Metrics = Annotated[
    str | None,
    typer.Option(
        help="Coverage metrics that others published, on the same frames: `all`, or names as in `k_cover,s_mig` "
        "(docs/metrics.md)."
    ),
]
ErrorMaps = Annotated[bool, typer.Option("--error-maps", help="Draw maps of the standard errors too.")]
Rerun = Annotated[
    Path | None,
    typer.Option(help="Write clouds, boxes, rigs and maps to this .rrd file for the Rerun viewer (extra `rerun`)."),
]
Explain = Annotated[bool, typer.Option("--explain", help="Say what was left out because the scene did not need it.")]
Device = Annotated[str, typer.Option(help="Where the search and the sums run: cpu, cuda, cuda:1, ...")]
Workers = Annotated[int, typer.Option(min=0, help="Processes that make frames; 0 makes them in this one.")]
Resume = Annotated[
    bool,
    typer.Option(
        "--resume",
        help="Go on from the checkpoint in --out, whatever ended that run; from a complete one with more --steps.",
    ),
]
SkipBadFrames = Annotated[
    bool, typer.Option("--skip-bad-frames", help="Skip and count frames that cannot be read, instead of stopping.")
]
