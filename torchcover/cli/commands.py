"""Commands that evaluate, check and search; their implementation is imported when they run."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from torchcover.cli import options
from torchcover.cli.options import build_criterion_options, build_setting_options, with_options
from torchcover.evaluation.config import STUDY_SETTINGS, format_defaults, load_config


@with_options(
    build_setting_options(
        "scenario", "vehicle", "regions", "thresholds_m", "reference", "num_rays", "seed", "device", "num_workers"
    )
)
def study(
    rig: options.RigArgument,
    num_frames: Annotated[
        int, typer.Option(min=8, help="Frames of the given settings; variants use the first quarter of them.")
    ] = 512,
    out: options.OutOption = Path("out"),
    config: options.ConfigOption = None,
    assignments: options.AssignmentsOption = None,
    **option_values: Any,  # noqa: ANN401
) -> None:
    """Find the fastest settings for a target error: run time, bias and needed frames of several settings."""
    from torchcover.cli.printing import print_study
    from torchcover.evaluation import Settings, StudyPlan, count_ranks, measure_error_against_time
    from torchcover.files import lock_folder

    if count_ranks() > 1:
        raise ValueError("study measures run times, which several ranks would change: run it without torchrun")
    loaded = load_config(config, assignments or (), options.find_changed_settings(option_values))
    settings = loaded.config.get_changed_settings()
    settings.pop("num_frames", None)  # the option of this command has a default of its own
    if unused := settings.keys() - set(STUDY_SETTINGS):
        raise ValueError(f"study does not take {', '.join(sorted(unused))}; it takes {', '.join(STUDY_SETTINGS)}")
    # The variants cast fewer reference rays than the default of the surface reference.
    has_variants = "num_rays" not in settings and settings.get("reference") != "paper"
    plan = StudyPlan(Settings(rig, num_frames=num_frames, **settings), StudyPlan.variants if has_variants else ())
    with lock_folder(out):
        result = measure_error_against_time(plan, show_progress=True)
        files = result.save(out)
    print_study(result, files, out)


def config() -> None:
    """Print all settings of a run with defaults and comments, for `--config`: torchcover config > run.yaml."""
    typer.echo(format_defaults(), nl=False)


@with_options(build_setting_options("vehicle"))
def show(
    name: Annotated[
        str, typer.Argument(help="Rig, scenario or vehicle: a built-in name (see `list`), a YAML file or a mesh.")
    ],
    scenario: Annotated[
        str | None, typer.Option(help="For a rig: scenario with its ego vehicle and its depth images (courtyard).")
    ] = None,
    rig: Annotated[str | None, typer.Option(help="For a scenario: rig whose points to plot (front_roof_128).")] = None,
    frame_index: Annotated[
        int | None, typer.Option(min=0, help="Frame of the scenario or the depth images (0).")
    ] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the simulation (0).")] = None,
    animation: Annotated[
        Path | None, typer.Option(help="For a scenario: file for 10 s from that frame on, .gif or .mp4 (ffmpeg).")
    ] = None,
    out: options.OutOption = Path("out"),
    **settings: Any,  # noqa: ANN401
) -> None:
    """Plot a rig and the depth images of its cameras, a frame of a scenario, or the mount regions of a vehicle."""
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
            help="Test target: child (1.10 m), adult, dog, cyclist, pole, a built-in vehicle, its YAML file, or a mesh."
        ),
    ] = "child",
    scenario: Annotated[
        str | None, typer.Option(help="Scenario: a built-in name or a YAML file. Default: flat ground, nothing else.")
    ] = None,
    num_frames: Annotated[
        int | None, typer.Option(min=1, help="Frames to average (16, or 1 if all frames are equal).")
    ] = None,
    raster: Annotated[
        str | None, typer.Option(help="Positions x0,x1,y0,y1,spacing in meters (5 m around the vehicle, 0.2).")
    ] = None,
    heading: Annotated[
        str, typer.Option(help="Side of the target that faces the vehicle: narrow, wide, or its yaw in degrees.")
    ] = "narrow",
    detection_points: Annotated[int, typer.Option(min=1, help="Fewest points on a detected target.")] = 5,
    threshold_m: Annotated[
        float, typer.Option("--threshold-m", help="Detection threshold of the surface of the target in meters.")
    ] = 0.4,
    out: options.OutOption = Path("out/targets"),
    files: options.FilesOption = options.ALL_FILES,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Map the points on a test target around the vehicle, and find positions where it is not detected."""
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
    target: Annotated[str, typer.Option(help="Test target on flat ground, as in `targets`.")] = "child",
    encounters: Annotated[str | None, typer.Option(help="Set of encounters, as in `encounter`. Default: none.")] = None,
    requirements: Annotated[str | None, typer.Option(help="Requirements, as in `check`. Default: none.")] = None,
    num_frames: Annotated[int, typer.Option(min=1, help="Frames of the traffic.")] = 64,
    budget: Annotated[
        str | None, typer.Option(help="Time after which the traffic ends, as in 90s or 5min. Default: all frames.")
    ] = None,
    out: options.OutOption = Path("out/report"),
    files: options.FilesOption = "numbers,page",
    **settings: Any,  # noqa: ANN401
) -> None:
    """Write one page for a meeting: child detection, loss if a sensor fails, range, and time to collision."""
    from torchcover.cli.printing import print_files, print_verdict
    from torchcover.evaluation import report
    from torchcover.files import lock_folder
    from torchcover.report import Terminal

    if budget is not None:
        settings["budget_s"] = parse_budget_s(budget)
    with lock_folder(out):
        result = report(
            rigs,
            scenario,
            target,
            encounters=encounters,
            requirements=requirements,
            num_frames=num_frames,
            show_progress=True,
            **settings,
        )
        written = result.save(out, file_kinds=files)
    console = Terminal()
    print_files(written, out, console)
    print_verdict(result.verdict, console)
    # Results are saved first; then an interrupted run ends with the code of its signal.
    if result.result.run is not None:
        result.result.run.raise_failure()


@with_options(build_setting_options("vehicle", "sensor_model", "num_frames", "seed", "num_workers"))
def check(
    rigs: options.RigsArgument,
    requirements: Annotated[str, typer.Option(help="Requirements: a built-in set or a YAML file.")],
    scenario: Annotated[
        str | None,
        typer.Option(help="Scenario instead of the file's (default there: courtyard for regions, flat for targets)."),
    ] = None,
    out: options.OutOption = Path("out/check"),
    **settings: Any,  # noqa: ANN401
) -> None:
    """Check requirements, as in CI. Exit code 0: all requirements are met; 1: one is not met or not decided."""
    from torchcover.cli.printing import print_files, print_verdict
    from torchcover.evaluation import check
    from torchcover.files import lock_folder
    from torchcover.report import Terminal, print_page_tables

    with lock_folder(out):
        result = check(rigs, requirements, scenario, progress=True, **settings)
        written = result.save(out)
    print_page_tables(result.build_tables())
    print_files(written, out, Terminal())
    print_verdict(result.verdict, Terminal())
    raise typer.Exit(0 if result.is_met else 1)


@with_options([*build_criterion_options(), *build_setting_options("vehicle", "sensor_model", "seed")])
def encounter(
    context: typer.Context,
    rigs: Annotated[
        list[str] | None, typer.Argument(help="Rigs: built-in names (see `list`) or YAML files; not with --frames.")
    ] = None,
    encounters: Annotated[
        str, typer.Option("--encounters", help="Set of encounters: a built-in name or a YAML file.")
    ] = "crossing_like",
    scenario: Annotated[
        str | None, typer.Option(help="Scenario whose traffic has the encounters, such as `urban`, instead of a set.")
    ] = None,
    frames: Annotated[
        Path | None, typer.Option(help="Recording with poses and labeled objects, instead of a set.")
    ] = None,
    num_start_offsets: Annotated[
        int, typer.Option(min=1, help="For a set: number of start times of the scans within their period.")
    ] = 10,
    num_scenes: Annotated[int, typer.Option(min=1, help="For a scenario: number of scenes.")] = 16,
    animation: Annotated[
        Path | None, typer.Option(help="For a set: file for the latest detection of the first rig, .gif or .mp4.")
    ] = None,
    out: options.OutOption = Path("out/encounters"),
    files: options.FilesOption = options.ALL_FILES,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Evaluate the time to collision at first detection, for crossings and other encounters."""
    from torchcover import evaluation
    from torchcover.cli.printing import print_files, print_verdict
    from torchcover.encounters import Criterion
    from torchcover.files import lock_folder
    from torchcover.report import Terminal, check_animation, print_page_tables, write_animation

    criterion = Criterion(**{name: settings.pop(name) for name in Criterion.__annotations__})
    if frames is not None:
        source = "--frames, which defines rigs and traffic"
        unused = {"rigs", "encounters", "scenario", "num_start_offsets", "num_scenes", "animation", "pixels", *settings}
    elif scenario is not None:
        source, unused = "--scenario, which defines the traffic", {"encounters", "num_start_offsets", "animation"}
    else:
        source, unused = "a set", {"num_scenes", "max_ttc_s"}
    # Options have defaults: only the source tells whether the user gave one that has no effect.
    for parameter in context.command.params:
        origin = context.get_parameter_source(parameter.name or "")
        if parameter.name in unused and origin is not None and origin.name == "COMMANDLINE":
            raise ValueError(f"{parameter.opts[0]}: has no effect with {source}; omit it")
    if animation is not None:
        check_animation(animation)  # an invalid file name is reported before the run
    with lock_folder(out):
        if frames is not None:
            results = evaluation.evaluate_recorded_encounters(frames, criterion)
        elif scenario is not None:
            results = evaluation.evaluate_traffic_encounters(
                rigs or (), scenario, criterion, num_scenes=num_scenes, progress=True, **settings
            )
        else:
            results = evaluation.evaluate_encounters(
                rigs or (), encounters, criterion, num_start_offsets=num_start_offsets, progress=True, **settings
            )
        written = evaluation.save_encounters(results, out, file_kinds=files)
    if animation is not None:
        vehicle, sensor_model = settings.get("vehicle"), settings.get("sensor_model")
        frames_of_animation = evaluation.plot_encounter_animation(
            (rigs or [])[0], results, vehicle=vehicle, sensor_model=sensor_model
        )
        write_animation(animation, frames_of_animation, frames_per_s=10)
    print_page_tables(results.build_tables())
    print_files(written, out, Terminal())
    print_verdict(evaluation.summarize_encounters(results), Terminal())


@with_options(build_setting_options("sensor_model"))
def search(
    space: Annotated[Path, typer.Argument(help="YAML file of variables, constraints and objectives.")],
    budget: Annotated[
        str | None, typer.Option(help="Time for the whole search, as in 90s, 30min (default) or 2h.")
    ] = None,
    num_evaluations: Annotated[
        int | None, typer.Option(min=1, help="Number of candidates instead of a time: equal results on any machine.")
    ] = None,
    average: Annotated[
        Literal["area", "cells"],
        typer.Option(help="Average of a score: over the visible surface (`area`) or the observed cells (`cells`)."),
    ] = "area",
    num_scenes: Annotated[int | None, typer.Option(min=1, help="Scenes of each scenario for the search (6).")] = None,
    num_held_out_scenes: Annotated[
        int | None, typer.Option(min=1, help="Held-out scenes of each scenario for the validation (16).")
    ] = None,
    frames_per_scene: Annotated[int | None, typer.Option(min=1, help="Frames of each scene (3).")] = None,
    frame_interval_s: Annotated[
        float | None, typer.Option("--frame-interval-s", help="Seconds between two frames (20).")
    ] = None,
    num_rays: Annotated[int | None, typer.Option(min=1, help="Reference rays per frame (16384).")] = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the search and its scenes; held-out scenes have the next one.")
    ] = 0,
    num_workers: Annotated[
        int | None, typer.Option(min=0, help="Worker processes; 0: none. Default: as many as shorten the search.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the search whose journal is in --out.")] = False,
    out: options.OutOption = Path("out/search"),
    files: options.FilesOption = options.ALL_FILES,
    **settings: Any,  # noqa: ANN401
) -> None:
    """Search for better mounting positions, or select sensors, and validate the result on held-out scenes."""
    from torchcover.cli.search_run import run_search_command

    if budget is not None and num_evaluations is not None:
        raise ValueError("--budget, --num-evaluations: one of them is needed; got both")
    settings |= {
        "num_scenes": num_scenes,
        "num_held_out_scenes": num_held_out_scenes,
        "frames_per_scene": frames_per_scene,
        "frame_interval_s": frame_interval_s,
        "num_rays": num_rays,
        "num_workers": num_workers,
    }
    run_search_command(
        space,
        out,
        resume=resume,
        file_kinds=files,
        num_evaluations=num_evaluations,
        budget_s=None if budget is None else parse_budget_s(budget),
        average=average,
        seed=seed,
        **{name: value for name, value in settings.items() if value is not None},
    )


def parse_budget_s(text: str) -> float:
    """Parse a time with a unit.

    Args:
        text: Number with s, min or h.

    Returns:
        Seconds.

    Raises:
        ValueError: Not a number with a unit.

    Example:
        >>> parse_budget_s("30min"), parse_budget_s("1.5h"), parse_budget_s("90 s")
        (1800.0, 5400.0, 90.0)
    """
    match = re.fullmatch(r"\s*(\d{1,9}(?:\.\d{1,9})?)\s*(s|min|h)\s*", text)
    if match is None:
        raise ValueError(f"--budget: a time is needed, as in 90s, 30min or 2h; got {text!r}")
    return float(match[1]) * {"s": 1.0, "min": 60.0, "h": 3600.0}[match[2]]


def list_builtin(
    search_text: Annotated[
        str | None, typer.Argument(help="Kind of items, such as `rigs`, or a text to find in names and descriptions.")
    ] = None,
) -> None:
    """List built-in rigs, scenarios, LiDAR models, vehicles, materials, weather, encounters, requirements."""
    from torchcover.cli.listing import print_builtin

    print_builtin(search_text)
