"""What each command is called with; what it does is imported when it runs."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from torchcover.cli import options
from torchcover.cli.options import build_criterion_options, build_setting_options, with_options
from torchcover.evaluation.config import STUDY_SETTINGS, format_defaults, load_config

UNITS_S = {"s": 1.0, "min": 60.0, "h": 3600.0}


@with_options(
    build_setting_options(
        "scenario", "vehicle", "regions", "thresholds_m", "reference", "num_rays", "seed", "device", "num_workers"
    )
)
def study(
    rig: options.RigArgument,
    num_frames: Annotated[
        int, typer.Option(min=8, help="Steps of the first setting; the others see the first quarter of these instants.")
    ] = 512,
    out: options.OutOption = Path("out"),
    config: options.ConfigOption = None,
    assignments: options.AssignmentsOption = None,
    **given: Any,  # noqa: ANN401
) -> None:
    """Find the setting for a wanted error: what each costs, how far it is off, and how many steps it needs."""
    from torchcover.cli.printing import print_study
    from torchcover.evaluation import Settings, StudyPlan, count_ranks, measure_error_against_time
    from torchcover.files import lock_folder

    if count_ranks() > 1:
        raise ValueError("study measures run times, which several ranks would change: run it without torchrun")
    settings = load_config(
        config, assignments or (), options.find_changed_settings(given)
    ).config.get_changed_settings()
    settings.pop("num_frames", None)
    if unused := settings.keys() - set(STUDY_SETTINGS):
        raise ValueError(f"study does not take {', '.join(sorted(unused))}; it takes {', '.join(STUDY_SETTINGS)}")
    fewer = "num_rays" not in settings and settings.get("reference") != "paper"
    plan = StudyPlan(Settings(rig, num_frames=num_frames, **settings), StudyPlan.variants if fewer else ())
    with lock_folder(out):
        found = measure_error_against_time(plan, show_progress=True)
        files = found.save(out)
    print_study(found, files, out)


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
    num_frames: Annotated[int | None, typer.Option(min=1, help="Steps to simulate (64), a frame each.")] = None,
    layout: Annotated[
        str, typer.Option("--format", help="`folder`, or `kitti`: KITTI's object layout, of a rig of one LiDAR.")
    ] = "folder",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on after the last frame in --out, whatever ended that command.")
    ] = False,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Write what a simulated rig sees as a recording, for other tools and for `evaluate --frames`."""
    from torchcover.evaluation import Settings
    from torchcover.evaluation.task import build_simulation_task
    from torchcover.files import RECORDING, read_manifest
    from torchcover.simulation import Rig, write_recording

    frames = build_simulation_task(Settings(Rig.load(rig), num_frames=num_frames, **settings), needs_boxes=True).frames
    try:
        write_recording(frames, out, layout, resume=resume, progress=_with_a_bar)
    except BaseException:
        if kept := (read_manifest(out / RECORDING) or {}).get("steps"):
            typer.echo(f"torchcover: {len(kept):,} of {len(frames):,} frames are kept; go on by --resume", err=True)
        raise
    typer.echo(f"Wrote {len(frames)} frames to {out}; read them with: torchcover evaluate --frames {out}")


def _with_a_bar(steps: range) -> Iterator[int]:
    from torchcover.evaluation.progress import Progress

    with Progress(steps.stop, "record", num_done=steps.start, is_shown=True) as bar:
        for step in steps:
            yield step
            bar.advance(steps.stop)


def rig(
    frames: Annotated[Path, typer.Option("--frames", help="The recording, of any layout in docs/recordings.md.")],
    assignments: options.AssignmentsOption = None,
    sensors: Annotated[
        list[str] | None,
        typer.Option("--sensors", help="Its sensors, as in `roof,left`. Not given: all of the recording."),
    ] = None,
    lidar: Annotated[
        list[str] | None,
        typer.Option(help="SENSOR=MODEL: a LiDAR scans as this model (see `list`), and is not estimated."),
    ] = None,
    raw_images: Annotated[
        bool,
        typer.Option(
            "--raw-images", help="Cameras with the distortion of their lenses, which released images no longer have."
        ),
    ] = False,
) -> None:
    """Print the sensors of a recording as a rig: mounts, LiDARs and cameras for `show` and `evaluate`."""
    from torchcover.files import to_yaml
    from torchcover.simulation import build_rig_document

    models = dict(_pair(text, "--lidar", "LIDAR_TOP=velodyne_hdl32e") for text in lidar or ())
    names = [name for of in sensors or () for name in of.split(",")]
    recording = options.open_recording(frames, options.load_recording_settings(assignments))
    document = build_rig_document(recording, sensor_names=names or None, lidar_models=models, raw_images=raw_images)
    typer.echo(to_yaml(document), nl=False)


def world(
    recording: Annotated[Path, typer.Argument(help="A drive with poses, of any layout in docs/recordings.md.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for scenario.yaml and its files.", callback=options.check_out)
    ],
    num_frames: Annotated[
        int | None, typer.Option(min=1, help="How many of its frames, from the first on (all).")
    ] = None,
    assignments: options.AssignmentsOption = None,
    vehicle: Annotated[
        str | None, typer.Option(help="Vehicle that recorded it: a name, a file, or x0,x1,y0,y1,z0,z1 of its body.")
    ] = None,
) -> None:
    """Make a drive a scenario: the ground and all that stands as it was seen, what moves on its tracks."""
    from torchcover.simulation import write_scenario

    opened = options.open_recording(recording, options.load_recording_settings(assignments), vehicle)
    told = write_scenario(opened, out, num_frames=num_frames)
    typer.echo(f"{told}. Wrote {out}; try rigs in it: torchcover evaluate RIG --scenario {out / 'scenario.yaml'}")


def config() -> None:
    """Print all settings of a run with defaults and comments, for `--config`: torchcover config > run.yaml."""
    typer.echo(format_defaults(), nl=False)


def robot(
    urdf: Annotated[Path, typer.Argument(help="URDF file; of xacro what `xacro FILE` prints.")],
    package: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER: a ROS package that meshes are in, if it does not lie around the file."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", help="Folder for the vehicle and the rig.")] = Path("robot"),
) -> None:
    """Make a vehicle and a rig of a robot's URDF: its body, and the sensors of its Gazebo tags."""
    from torchcover.simulation import read_robot

    found = read_robot(urdf, dict(_pair(text, "--package", "my_robot=src/my_robot") for text in package or ()))
    found.save(out)
    for note in found.notes:
        typer.echo(note)
    rig = f"{out / 'rig.yaml'} with {len(found.sensors)} sensors; look at it: torchcover show {out / 'rig.yaml'}"
    none = f"no rig, for it has no sensor in a tag of Gazebo; look at it: torchcover show {out / 'vehicle.yaml'}"
    typer.echo(f"Wrote {out / 'vehicle.yaml'} and {rig if found.sensors else none}")


def calibrate(
    recording: Annotated[Path, typer.Argument(help="A drive on a straight road, of any layout in docs/recordings.md.")],
    rig: Annotated[
        str,
        typer.Option(help="Rig that recorded it, whose LiDARs are called as there: a built-in name or a YAML file."),
    ],
    assignments: options.AssignmentsOption = None,
    out: Annotated[Path, typer.Option("--out", help="YAML file for the rig with what was found.")] = Path("rig.yaml"),
) -> None:
    """Fit how far each LiDAR of a rig sees, and its noise, to a recording: from road that did or did not return."""
    from torchcover.simulation import Rig, calibrate

    opened = options.open_recording(recording, options.load_recording_settings(assignments))
    calibrated, found = calibrate(opened, Rig.load(rig))
    calibrated.save(out)
    for one in found:
        typer.echo(one.text)
    typer.echo(f"Wrote {out}; simulate with it: torchcover evaluate {out}")


def _pair(text: str, option: str, example: str) -> tuple[str, str]:
    name, _, value = text.partition("=")
    if not (name and value):
        raise ValueError(f"{option} {text}: NAME=VALUE is needed, as in {example}")
    return name, value


@with_options(build_setting_options("vehicle"))
def show(
    name: Annotated[
        str, typer.Argument(help="Rig, scenario or vehicle: a built-in name (see `list`), a YAML file or a mesh.")
    ],
    scenario: Annotated[
        str | None, typer.Option(help="For a rig: the scenario whose ego carries it and that it sees (courtyard).")
    ] = None,
    rig: Annotated[str | None, typer.Option(help="For a scenario: whose points to draw (front_roof_128).")] = None,
    frame_index: Annotated[
        int | None, typer.Option(min=0, help="Time step of the scenario or the depth images (0).")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the simulation, likewise (0).")] = None,
    animation: Annotated[
        Path | None, typer.Option(help="For a scenario: 10 s of it from that step on, as a .gif or .mp4 (ffmpeg) file.")
    ] = None,
    out: options.OutOption = Path("out"),
    **settings: Any,  # noqa: ANN401
) -> None:
    """Draw a rig and the depth images of its cameras, a frame of a scenario, or the mount regions of a vehicle."""
    from torchcover.cli.show import show_item

    show_item(
        name, scenario=scenario, rig=rig, frame_index=frame_index, seed=seed, animation=animation, out=out, **settings
    )


@with_options(build_setting_options("vehicle", "sensor_model", "frame_interval_s", "seed"))
def targets(
    rig: options.RigArgument,
    target: Annotated[
        str,
        typer.Option(
            help="What is put around the vehicle: child (1.10 m), adult, dog, cyclist, pole, a built-in vehicle, the "
            "YAML file of one, or a mesh file."
        ),
    ] = "child",
    scenario: Annotated[
        str | None, typer.Option(help="Scenario: a built-in name or a YAML file. Not given: flat ground, nothing else.")
    ] = None,
    num_frames: Annotated[
        int | None, typer.Option(min=1, help="Steps to average (16, or 1 where nothing moves and no sensor is noisy).")
    ] = None,
    raster: Annotated[
        str | None, typer.Option(help="Cells x0,x1,y0,y1,step in metres (within 5 m of the vehicle, step 0.2).")
    ] = None,
    heading: Annotated[
        str, typer.Option(help="Side that it turns to the vehicle: narrow, wide, or its yaw in degrees.")
    ] = "narrow",
    detection_points: Annotated[int, typer.Option(min=1, help="Points that are enough to see it.")] = 5,
    threshold_m: Annotated[
        float, typer.Option("--threshold-m", help="Detection threshold in metres, for the share of its surface.")
    ] = 0.4,
    out: options.OutOption = Path("out/targets"),
    files: options.FilesOption = options.ALL_FILES,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Put a body at every place around the vehicle: how much of it is seen, and where not."""
    from torchcover.cli.target_run import run_targets_command

    run_targets_command(
        rig,
        target,
        scenario,
        raster=raster,
        num_frames=num_frames,
        detection_points=detection_points,
        threshold_m=threshold_m,
        heading=heading,
        out=out,
        file_kinds=files,
        **settings,
    )


@with_options(build_setting_options("vehicle", "sensor_model", "seed", "num_workers"))
def report(
    rigs: Annotated[list[str], typer.Argument(help="Rigs: built-in names (see `list`) or YAML files; at most 8.")],
    scenario: Annotated[str, typer.Option(help="Traffic: a built-in name or a YAML file.")] = "urban",
    target: Annotated[
        str, typer.Option(help="What is put beside the vehicle in free space, as of `targets`.")
    ] = "child",
    encounters: Annotated[
        str | None, typer.Option(help="Set of encounters, as of `encounter`. Not given: none.")
    ] = None,
    requirements: Annotated[
        str | None, typer.Option(help="What they must see, as of `check`. Not given: nothing.")
    ] = None,
    num_frames: Annotated[int, typer.Option(min=1, help="Steps of the traffic.")] = 64,
    budget: Annotated[
        str | None, typer.Option(help="Time after which the traffic ends, as in 90s or 5min. Not given: all steps.")
    ] = None,
    out: options.OutOption = Path("out/report"),
    files: options.FilesOption = "numbers,page",
    **settings: Any,  # noqa: ANN401
) -> None:
    """One page for a meeting: would it see a child, what fails with a sensor, how far does it see, and how soon."""
    from torchcover.cli.printing import print_files, print_verdict
    from torchcover.evaluation import report
    from torchcover.files import lock_folder
    from torchcover.report import Terminal

    if budget is not None:
        settings["budget_s"] = parse_budget_s(budget)
    with lock_folder(out):
        found = report(
            rigs,
            scenario,
            target,
            encounters=encounters,
            requirements=requirements,
            num_frames=num_frames,
            show_progress=True,
            **settings,
        )
        written = found.save(out, file_kinds=files)
    console = Terminal()
    print_files(written, out, console)
    print_verdict(found.verdict, console)
    if found.result.run is not None:
        found.result.run.raise_failure()


@with_options(build_setting_options("vehicle", "sensor_model", "num_frames", "seed", "num_workers"))
def check(
    rigs: Annotated[list[str], typer.Argument(help="Rigs: built-in names (see `list`) or YAML files.")],
    requirements: Annotated[str, typer.Option(help="What they must see: a built-in set or a YAML file.")],
    scenario: Annotated[
        str | None,
        typer.Option(
            help="World in place of the file's (which has for regions the courtyard, for bodies flat ground)."
        ),
    ] = None,
    out: options.OutOption = Path("out/check"),
    **settings: Any,  # noqa: ANN401
) -> None:
    """Check requirements, as in CI. Exit code 0: all are checked and met; 1: one is not met, or not checked."""
    from torchcover.cli.printing import print_files, print_verdict
    from torchcover.evaluation import check
    from torchcover.files import lock_folder
    from torchcover.report import Terminal, print_page_tables

    with lock_folder(out):
        found = check(rigs, requirements, scenario, progress=True, **settings)
        written = found.save(out)
    print_page_tables(found.build_tables())
    print_files(written, out, Terminal())
    print_verdict(found.verdict, Terminal())
    raise typer.Exit(0 if found.is_met else 1)


@with_options([*build_criterion_options(), *build_setting_options("vehicle", "sensor_model", "seed")])
def encounter(
    context: typer.Context,
    rigs: Annotated[
        list[str] | None,
        typer.Argument(help="Rigs: built-in names (see `list`) or YAML files; with --frames those of the recording."),
    ] = None,
    encounters: Annotated[
        str, typer.Option("--set", help="Set of encounters: a built-in name or a YAML file.")
    ] = "crossing_like",
    scenario: Annotated[
        str | None, typer.Option(help="Instead: whom the vehicle meets in the traffic of this scenario, as `urban`.")
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="Instead: whom it met in a recording with poses and labelled objects.")
    ] = None,
    num_start_offsets: Annotated[
        int, typer.Option(min=1, help="Of a set: at how many places of their period looks begin.")
    ] = 10,
    num_scenes: Annotated[
        int, typer.Option(min=1, help="Of a scenario: how many of its worlds are driven through.")
    ] = 16,
    animation: Annotated[
        Path | None, typer.Option(help="Of a set: film what the first rig detects latest, as a .gif or .mp4 file.")
    ] = None,
    out: options.OutOption = Path("out/encounters"),
    files: options.FilesOption = options.ALL_FILES,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Would it see the child in time? Of crossings and other encounters: the time to collision at detection."""
    from torchcover.cli.printing import print_files, print_verdict
    from torchcover.encounters import Criterion
    from torchcover.evaluation import (
        evaluate_encounters,
        evaluate_recorded_encounters,
        evaluate_traffic_encounters,
        plot_encounter_animation,
        save_encounters,
        summarize_encounters,
    )
    from torchcover.files import lock_folder
    from torchcover.report import Terminal, check_animation, print_page_tables, write_animation

    criterion = Criterion(**{name: settings.pop(name) for name in Criterion.__annotations__})
    what, unused = "a set", {"num_scenes", "max_ttc_s"}
    if frames is not None:
        what = "--frames, which has rigs and traffic of its own"
        unused = {"rigs", "encounters", "scenario", "num_start_offsets", "num_scenes", "animation", "pixels", *settings}
    elif scenario is not None:
        what, unused = "--scenario, whose traffic nobody stages", {"encounters", "num_start_offsets", "animation"}
    for each in context.command.params:
        source = context.get_parameter_source(each.name or "")
        if each.name in unused and source is not None and source.name == "COMMANDLINE":
            raise ValueError(f"{each.opts[0]}: of no use with {what}; leave it out")
    if animation is not None:
        check_animation(animation)
    with lock_folder(out):
        if frames is not None:
            found = evaluate_recorded_encounters(frames, criterion)
        elif scenario is not None:
            found = evaluate_traffic_encounters(
                rigs or (), scenario, criterion, num_scenes=num_scenes, progress=True, **settings
            )
        else:
            found = evaluate_encounters(
                rigs or (), encounters, criterion, num_start_offsets=num_start_offsets, progress=True, **settings
            )
        written = save_encounters(found, out, file_kinds=files)
    if animation is not None:
        told = {name: settings.get(name) for name in ("vehicle", "sensor_model")}
        write_animation(animation, plot_encounter_animation((rigs or [])[0], found, **told), frames_per_s=10)
    print_page_tables(found.build_tables())
    print_files(written, out, Terminal())
    print_verdict(summarize_encounters(found), Terminal())


@with_options(build_setting_options("sensor_model"))
def search(
    space: Annotated[Path, typer.Argument(help="YAML file of free variables, constraints and objectives.")],
    budget: Annotated[
        str | None, typer.Option(help="Time for all of it: 30min (if nothing is given), 90s, 2h; or --num-evaluations.")
    ] = None,
    num_evaluations: Annotated[
        int | None, typer.Option(min=1, help="Number of candidates instead of a time: the same ones on any machine.")
    ] = None,
    average: Annotated[
        Literal["area", "cells"],
        typer.Option(help="Average of a score: `area`, the visible surface, or `cells`, the observed cells."),
    ] = "area",
    num_scenes: Annotated[int | None, typer.Option(min=1, help="Worlds of each scenario to search in (6).")] = None,
    num_held_out_scenes: Annotated[
        int | None, typer.Option(min=1, help="Held-out worlds of each scenario to test in (16).")
    ] = None,
    frames_per_scene: Annotated[int | None, typer.Option(min=1, help="Frames of each world (3).")] = None,
    frame_interval_s: Annotated[
        float | None, typer.Option("--frame-interval-s", help="Seconds between two of them (20).")
    ] = None,
    num_rays: Annotated[int | None, typer.Option(min=1, help="Reference rays of each frame (16384).")] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the search and its worlds; held-out worlds have the next.")
    ] = 0,
    num_workers: Annotated[
        int | None, typer.Option(min=0, help="Processes that score; 0 scores in this one. Not given: as many as help.")
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the search whose journal is in --out.",
        ),
    ] = False,
    out: options.OutOption = Path("out/search"),
    files: options.FilesOption = options.ALL_FILES,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Search for better mounting positions, or select sensors, and test the result on held-out worlds."""
    from torchcover.cli.search_run import run_search_command

    if budget is not None and num_evaluations is not None:
        raise ValueError("--budget, --num-evaluations: one of them; both are given")
    given = {"num_scenes": num_scenes, "num_held_out_scenes": num_held_out_scenes, "frames_per_scene": frames_per_scene, "frame_interval_s": frame_interval_s,
             "num_rays": num_rays, "num_workers": num_workers, **settings}  # fmt: skip
    run_search_command(
        space,
        out,
        resume=resume,
        file_kinds=files,
        num_evaluations=num_evaluations,
        budget_s=None if budget is None else parse_budget_s(budget),
        average=average,
        seed=seed,
        **{name: value for name, value in given.items() if value is not None},
    )


def parse_budget_s(text: str) -> float:
    """Seconds.

    Raises:
        ValueError: No number with a unit.

    Example:
        >>> parse_budget_s("30min"), parse_budget_s("1.5h"), parse_budget_s("90 s")
        (1800.0, 5400.0, 90.0)
    """
    match = re.fullmatch(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*(s|min|h)\s*", text)
    if match is None:
        raise ValueError(f"--budget: a time is needed, as in 90s, 30min or 2h; got {text!r}")
    return float(match[1]) * UNITS_S[match[2]]


def list_builtin(
    search_text: Annotated[
        str | None,
        typer.Argument(help="A kind, as `rigs`: what each is. Or any word: those with it, with all that is said."),
    ] = None,
) -> None:
    """List the built-in rigs, scenarios, LiDAR models, vehicles, materials, weather, encounters and requirements."""
    from torchcover.cli.listing import print_builtin

    print_builtin(search_text)
