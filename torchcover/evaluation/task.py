"""What there is to measure: which rigs, in which frames."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from torchcover.evaluation.rig_names import AnyRig, distinct_names, given_as, is_document, loaded
from torchcover.evaluation.settings import DEFAULT_SCENARIO, DEFAULT_STEPS, Settings, spread_s
from torchcover.frames import BadFrameError, ChosenRigs, FrameSource
from torchcover.recordings import RecordedFrames
from torchcover.recordings.suspicion import suspicions
from torchcover.simulation import Asked, Scenario, Sensor, SimulatedFrames, reference_called, with_ego

AnyScenario = Scenario | str | Path
AnyFrames = FrameSource | str | Path


class Task(NamedTuple):
    """Which rigs are measured in which frames.

    Args:
        frames: Frames of these rigs, under the names that they have in tables and files.
        given: Name of each rig -> what the user called it; None if nobody named it.
        sensors: Name of each rig -> its sensors, where they are known.
        description: Where the frames come from, in words.
        asked: What is asked about.
        steps: Frames to use at most; None for all.
    """

    frames: FrameSource
    given: Mapping[str, str | None]
    sensors: Mapping[str, Sequence[Sensor]]
    description: Mapping[str, object]
    asked: Asked
    steps: int | None = None

    @property
    def rigs(self) -> tuple[str, ...]:
        """What the rigs are called in tables and files."""
        return tuple(self.given)

    @property
    def place(self) -> str:
        """Where the frames come from, for a message."""
        return str(self.description["frames"] or self.description["scenario"])

    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """Name of each rig -> names of its sensors, from the first frame that can be used.

        Raises:
            ValueError: It does not know which points are of which sensor, or no frame can be used.
        """
        if isinstance(self.frames, SimulatedFrames):
            return {name: [sensor.name for sensor in rig.sensors] for name, rig in self.frames.rigs.items()}
        for index in range(len(self.frames)):
            try:
                frame = self.frames[index]
            except BadFrameError:
                continue  # the run itself skips it, or ends with it
            return {name: list(frame.clouds_by_sensor(name)) for name in self.rigs}
        raise ValueError("redundancy: no frame can be used")


def task_of(rigs: Sequence[AnyRig], scenario: AnyScenario | None, frames: AnyFrames | None, settings: Settings) -> Task:
    """Simulate a scenario, or read a recording.

    Args:
        rigs: Those that were named; all of a recording if none.
        scenario: The world; None for the default.
        frames: A recording or another source instead.
        settings: The rest.

    Raises:
        ValueError: No rig, a scenario beside a recording, settings for the other of the two, a rig that is not there.
        FileNotFoundError: An unknown name or file.
        TypeError: Frames that do not say whose they are.

    Warns:
        UserWarning: A recording that looks wrong; see `torchcover.recordings.suspicion`.
    """
    if frames is None:
        return _simulation(rigs, DEFAULT_SCENARIO if scenario is None else scenario, settings)
    if scenario is not None:
        raise ValueError("scenario and frames exclude each other: simulate a scenario or read a recording")
    settings.check_recording()
    source = RecordedFrames(frames) if isinstance(frames, str | Path) else frames
    if isinstance(source, RecordedFrames):
        for doubt in suspicions(source, settings.steps):
            warnings.warn(doubt, stacklevel=3)  # where `evaluate` or `compare` is called from
    if not isinstance(source, FrameSource):
        missing = [name for name in vars(FrameSource) if not name.startswith("_") and not hasattr(source, name)]
        raise TypeError(
            f"frames: a recording's path or a torchcover.data.FrameSource is needed; got {type(source).__name__}, "
            f"which has no {', '.join(missing)}; for a list of frames, or a dataset, feed observers: "
            "torchcover.evaluation.observe(frames, observers)"
        )
    return _recording(rigs, source, settings)


def _simulation(rigs: Sequence[AnyRig], scenario: AnyScenario, settings: Settings) -> Task:
    if not rigs:
        raise ValueError("which rig? Give a built-in name (see `torchcover list`) or a YAML file, or a recording")
    names = distinct_names(rigs)
    carried = {name: loaded(rig) for name, rig in zip(names, rigs, strict=True)}
    loaded_world = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    world = with_ego(loaded_world, carried, settings.vehicle)
    asked = settings.asked(world.ego_box().outline_m)
    frames = SimulatedFrames(
        world,
        rigs=carried,
        steps=settings.simulated_steps,
        seed=settings.seed,
        every_s=spread_s(world, settings.every_s),
        reference_sensor=reference_called(settings.reference_sensor, settings.rays, asked),
        boxes=settings.needs_boxes,
    )
    frames.simulator.check_run(frames.steps)
    given = {name: given_as(rig) for name, rig in zip(names, rigs, strict=True)}
    # A path says more than the name within the file.
    description = {**frames.description, "scenario": world.name if loaded_world is scenario else str(scenario)}
    return Task(frames, given, frames.sensors, description, asked, _most_steps(frames, settings))


def _most_steps(frames: SimulatedFrames, settings: Settings) -> int | None:
    """Where a target error ends a run at the latest: what repeats and moves has no more to say than its instants."""
    distinct = frames.simulator.distinct_steps
    if settings.steps is not None or settings.target_error is None or distinct in (None, 1):
        return None
    return max(DEFAULT_STEPS, distinct)


def _recording(rigs: Sequence[AnyRig], frames: FrameSource, settings: Settings) -> Task:
    names = distinct_names(rigs or list(frames.rigs))
    only_one = len(names) == len(frames.rigs) == 1  # which goes by any name
    chosen = ChosenRigs(frames, dict(zip(names, frames.rigs if only_one else names, strict=True)))
    named = dict(zip(names, rigs, strict=True)) if rigs else {}
    given = {name: given_as(named[name]) if named else None for name in names}
    # A name that is in the recording may be a name only; any other has to be that of a rig.
    documents = {name: rig for name, rig in named.items() if is_document(rig) or name not in frames.rigs}
    sensors = {**chosen.sensors, **{name: loaded(rig).sensors for name, rig in documents.items()}}
    asked = settings.asked(frames.ego_outline_m)
    return Task(chosen, given, sensors, frames.description, asked, settings.steps)
