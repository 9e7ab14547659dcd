"""Commands that write or read recordings and robots; their implementation is imported when they run."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from torchcover.cli import options
from torchcover.cli.options import build_setting_options, with_options


@with_options(
    build_setting_options(
        "scenario", "seed", "vehicle", "sensor_model", "weather", "reference", "num_rays", "frame_interval_s"
    )
)
def record(
    rig: options.RigArgument,
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the recording, new or empty.", callback=options.check_out)
    ],
    num_frames: Annotated[int | None, typer.Option(min=1, help="Frames to simulate (64).")] = None,
    layout: Annotated[
        str, typer.Option("--format", help="`folder`, or `kitti`: object layout of KITTI, for a rig of one LiDAR.")
    ] = "folder",
    resume: Annotated[bool, typer.Option("--resume", help="Continue after the last frame in --out.")] = False,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Write a recording of a simulated rig, for other tools and for `evaluate --frames`."""
    from torchcover.evaluation import Settings
    from torchcover.evaluation.task import build_simulation_task
    from torchcover.files import RECORDING, read_manifest
    from torchcover.simulation import Rig, write_recording

    frames = build_simulation_task(Settings(Rig.load(rig), num_frames=num_frames, **settings), needs_boxes=True).frames
    try:
        write_recording(frames, out, layout, resume=resume, progress=_show_progress)
    except BaseException:  # also Ctrl-C: complete frames stay in the folder
        if written := (read_manifest(out / RECORDING) or {}).get("steps"):
            typer.echo(
                f"torchcover: {len(written):,} of {len(frames):,} frames are kept; continue with --resume", err=True
            )
        raise
    typer.echo(f"Wrote {len(frames)} frames to {out}; evaluate them: torchcover evaluate --frames {out}")


def _show_progress(frame_indices: range) -> Iterator[int]:
    """Iterate over the remaining frames and show a progress bar."""
    from torchcover.evaluation.progress import Progress

    with Progress(frame_indices.stop, "record", num_done=frame_indices.start, is_shown=True) as bar:
        for frame_index in frame_indices:
            yield frame_index
            bar.advance(frame_indices.stop)


def rig(
    frames: Annotated[Path, typer.Option("--frames", help="Recording; formats: docs/recordings.md.")],
    assignments: options.AssignmentsOption = None,
    sensors: Annotated[
        list[str] | None, typer.Option("--sensors", help="Sensors, as in `roof,left`. Default: all of the recording.")
    ] = None,
    lidar: Annotated[
        list[str] | None,
        typer.Option(help="SENSOR=MODEL: the model of a LiDAR (see `list`), which is not estimated then."),
    ] = None,
    raw_images: Annotated[
        bool, typer.Option("--raw-images", help="Cameras with lens distortion, which published images lack.")
    ] = False,
) -> None:
    """Print the sensors of a recording as a rig: extrinsics, LiDARs and cameras, for `show` and `evaluate`."""
    from torchcover.files import to_yaml
    from torchcover.simulation import build_rig_document

    models = dict(_parse_pair(text, "--lidar", "LIDAR_TOP=velodyne_hdl32e") for text in lidar or ())
    names = [name for text in sensors or () for name in text.split(",")]
    recording = options.open_recording(frames, options.load_recording_settings(assignments))
    document = build_rig_document(recording, sensor_names=names or None, lidar_models=models, raw_images=raw_images)
    typer.echo(to_yaml(document), nl=False)


def world(
    recording: Annotated[Path, typer.Argument(help="Drive with poses; formats: docs/recordings.md.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for scenario.yaml and its files.", callback=options.check_out)
    ],
    num_frames: Annotated[int | None, typer.Option(min=1, help="Number of frames from the first on (all).")] = None,
    assignments: options.AssignmentsOption = None,
    vehicle: Annotated[
        str | None, typer.Option(help="Ego vehicle: a built-in name, a file, or its box x0,x1,y0,y1,z0,z1 in meters.")
    ] = None,
) -> None:
    """Convert a drive to a scenario: ground, static surfaces, and moving objects on their tracks."""
    from torchcover.simulation import write_scenario

    opened = options.open_recording(recording, options.load_recording_settings(assignments), vehicle)
    summary = write_scenario(opened, out, num_frames=num_frames)
    scenario = out / "scenario.yaml"
    typer.echo(f"{summary}. Wrote {out}; evaluate rigs in it: torchcover evaluate RIG --scenario {scenario}")


def robot(
    urdf: Annotated[Path, typer.Argument(help="URDF file; convert xacro files with `xacro FILE`.")],
    package: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER: a ROS package of meshes that is not in a folder around the file."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the vehicle and the rig.")] = Path("robot"),
) -> None:
    """Convert the URDF of a robot to a vehicle and a rig: its body, and the sensors of its Gazebo tags."""
    from torchcover.simulation import read_robot

    robot = read_robot(urdf, dict(_parse_pair(text, "--package", "my_robot=src/my_robot") for text in package or ()))
    robot.save(out)
    for note in robot.notes:
        typer.echo(note)
    if robot.sensors:
        result = f"{out / 'rig.yaml'} with {len(robot.sensors)} sensors; plot it: torchcover show {out / 'rig.yaml'}"
    else:
        result = f"no rig: no Gazebo tag has a sensor; plot the vehicle: torchcover show {out / 'vehicle.yaml'}"
    typer.echo(f"Wrote {out / 'vehicle.yaml'} and {result}")


def calibrate(
    recording: Annotated[Path, typer.Argument(help="Drive on a straight road; formats: docs/recordings.md.")],
    rig: Annotated[
        str, typer.Option(help="Rig that recorded it, with the same names of LiDARs: a built-in name or a YAML file.")
    ],
    assignments: options.AssignmentsOption = None,
    out: Annotated[Path, typer.Option("--out", help="YAML file for the calibrated rig.")] = Path("rig.yaml"),
) -> None:
    """Fit range and noise of the LiDARs of a rig to a recording, from the returns of a straight road."""
    from torchcover.simulation import Rig, calibrate

    opened = options.open_recording(recording, options.load_recording_settings(assignments))
    calibrated, results = calibrate(opened, Rig.load(rig))
    calibrated.save(out)
    for result in results:
        typer.echo(result.text)
    typer.echo(f"Wrote {out}; simulate with it: torchcover evaluate {out}")


def _parse_pair(text: str, option: str, example: str) -> tuple[str, str]:
    """Parse NAME=VALUE.

    Args:
        text: The text.
        option: Option to which it belongs, for the error message.
        example: Example for the error message.
    """
    name, _, value = text.partition("=")
    if not (name and value):
        raise ValueError(f"{option} {text}: NAME=VALUE is needed, as in {example}")
    return name, value
