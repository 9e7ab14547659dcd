"""Visibility of a test target around a vehicle: measurement from names and files, and output files."""

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torchcover.evaluation.progress import defer_signals
from torchcover.evaluation.rig_names import AnyRig, load_named_rig
from torchcover.evaluation.settings import FILES, parse_file_kinds
from torchcover.evaluation.target_page import build_target_page, build_target_record
from torchcover.evaluation.task import AnyScenario, compute_frame_interval_s
from torchcover.files import AtomicOutput
from torchcover.report import render_page
from torchcover.simulation import Rig, Scenario, Sensor, set_ego
from torchcover.simulation.bodies import Body
from torchcover.simulation.scenario import ActorDescription
from torchcover.simulation.shapes import Plane
from torchcover.targets import Target, TargetMap, measure_target_visibility, write_arrays, write_csv


def map_target_visibility(
    rig: AnyRig,
    target: Target | str | Path = "child",
    scenario: Scenario | str | Path | None = None,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    num_frames: int | None = None,
    frame_interval_s: float | None = None,
    **settings: Any,  # noqa: ANN401  (parameters of `measure_target_visibility`)
) -> TargetMap:
    """Measure the visibility of a test target at every position around a vehicle.

    Args:
        rig: The rig, a built-in name, or a YAML file.
        target: "child", "adult", "dog", "cyclist", "pole", a built-in vehicle, its YAML file, or a mesh file.
        scenario: The scenario, a built-in name or a YAML file; flat ground without obstacles by default.
        vehicle: Vehicle that carries the rig, as in `evaluate`, or a mesh file.
        sensor_model: Sensor model, as in `evaluate`.
        num_frames: Number of frames that are averaged; by default 1 if all frames are equal, else 16.
        frame_interval_s: Time between two frames; by default as in `evaluate`.
        settings: Further parameters of `torchcover.targets.measure_target_visibility`: `raster`, `seed`,
            `detection_points`, `threshold_m`, `heading`.

    Returns:
        Points, detecting sensors and visible surface for each position.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: Invalid file, or a number out of its bounds.

    Example:
        >>> from torchcover.targets import Raster
        >>> target_map = map_target_visibility("front_roof_128", "dog", raster=Raster((3.0, 7.0), (-1.0, 1.0), 1.0))
        >>> target_map.target, target_map.counts["free"]
        ('dog_57cm', 8)
    """
    rig, loaded_scenario, default_num_frames = load_rig_and_scenario(rig, scenario, vehicle, sensor_model)
    return measure_target_visibility(
        rig,
        loaded_scenario,
        target if isinstance(target, Target) else Target.load(target),
        num_frames=default_num_frames if num_frames is None else num_frames,
        frame_interval_s=compute_frame_interval_s(loaded_scenario, frame_interval_s),
        **settings,
    )


def load_rig_and_scenario(
    rig: AnyRig, scenario: AnyScenario | None, vehicle: str | Path | None, sensor_model: Literal["ideal", "real"] | None
) -> tuple[Rig, Scenario, int]:
    """Load a rig and the scenario whose ego vehicle carries it.

    Args:
        rig: The rig, a built-in name, or a YAML file.
        scenario: The scenario, a built-in name or a YAML file; flat ground if None.
        vehicle: Vehicle that carries the rig; None for the vehicle of the scenario or the rig.
        sensor_model: Sensor model; None for the default of the rig.

    Returns:
        Rig, scenario, and default number of frames: 1 if nothing moves and no sensor is noisy, else 16.

    Raises:
        FileNotFoundError: Unknown file or built-in name.
        ValueError: Invalid file.
    """
    rig = load_named_rig(rig).apply_sensor_model(sensor_model)
    scenario = build_flat_ground() if scenario is None else scenario
    scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    scenario = set_ego(scenario, {rig.name: rig}, vehicle)
    has_equal_frames = scenario.num_distinct_time_steps == 1 and all(sensor.is_exact for sensor in rig.sensors)
    return rig, scenario, 1 if has_equal_frames else 16


def build_flat_ground(size_m: float = 2000.0) -> Scenario:
    """Build a scenario of flat ground with nothing on it except the ego vehicle.

    Args:
        size_m: Length and width of the ground.

    Returns:
        The scenario, named "free space".

    Example:
        >>> build_flat_ground().num_distinct_time_steps
        1
    """
    ground = Body(name="ground", shape=Plane(type="plane", size_m=(size_m, size_m)))
    return Scenario(name="free space", ego=ActorDescription(), bodies=(ground,))


def save_target_map(
    target_map: TargetMap,
    folder: str | Path,
    sensors: Sequence[Sensor] = (),
    *,
    file_kinds: str | Iterable[str] = FILES,
) -> list[Path]:
    """Write the files of the command line: first the numbers, then the page and the plot.

    Args:
        target_map: Result of `map_target_visibility`.
        folder: Folder of `targets.csv`, `targets.npz`, `report.html`, `targets.png` and `summary.json`, created if
            necessary. Files of an earlier run that its `summary.json` lists are deleted.
        sensors: Sensors of the rig, for the page.
        file_kinds: Files besides `summary.json`, as in `Result.save`; "maps" is the plot.

    Returns:
        Paths of the files.

    Raises:
        ValueError: A file kind is unknown.
    """
    kinds = parse_file_kinds(file_kinds)
    record = build_target_record(target_map)
    with AtomicOutput(Path(folder)) as output:
        with defer_signals():  # the numbers are complete before a signal ends the process
            if "numbers" in kinds:
                output.add("targets.csv", partial(write_csv, target_map))
                output.add("targets.npz", partial(write_arrays, target_map))
            output.publish(record)
        if "page" in kinds:
            output.add_text("report.html", render_page(build_target_page(target_map, sensors)))
        if "maps" in kinds:
            output.add_figure("targets.png", target_map.plot())
        output.publish(record)
    return output.paths
