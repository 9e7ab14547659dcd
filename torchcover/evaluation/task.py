"""What there is to measure: which rigs, in which frames."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from torchcover.data import FrameSource, SimulatedFrames, open_recording
from torchcover.evaluation.rig_names import AnyRig, distinct_names, given_as, is_document, loaded
from torchcover.evaluation.settings import DEFAULT_SCENARIO, Settings, reference_called, spread_s
from torchcover.simulation import Scenario, Sensor

AnyScenario = Scenario | str | Path
AnyFrames = FrameSource | str | Path


class Task(NamedTuple):
    """Which rigs are measured in which frames.

    Args:
        frames: Where the frames come from.
        clouds: Name of each rig in tables and files -> in the frames.
        given: Name of each rig -> what the user called it; None if nobody named it.
        sensors: Name of each rig -> its sensors, where they are known.
        description: Where the frames come from, in words.
        steps: Frames to use at most; None for all.
    """

    frames: FrameSource
    clouds: Mapping[str, str]
    given: Mapping[str, str | None]
    sensors: Mapping[str, Sequence[Sensor]]
    description: Mapping[str, object]
    steps: int | None = None


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
    """
    if frames is None:
        return _simulation(rigs, DEFAULT_SCENARIO if scenario is None else scenario, settings)
    if scenario is not None:
        raise ValueError("scenario and frames exclude each other: simulate a scenario or read a recording")
    settings.check_recording()
    return _recording(rigs, open_recording(frames) if isinstance(frames, str | Path) else frames, settings)


def _simulation(rigs: Sequence[AnyRig], scenario: AnyScenario, settings: Settings) -> Task:
    if not rigs:
        raise ValueError("which rig? Give a built-in name (see `torchcover list`) or a YAML file, or a recording")
    names = distinct_names(rigs)
    world = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
    frames = SimulatedFrames(
        world,
        rigs={name: loaded(rig) for name, rig in zip(names, rigs, strict=True)},
        steps=settings.simulated_steps,
        seed=settings.seed,
        every_s=spread_s(world, settings.every_s),
        reference_sensor=reference_called(settings.reference, settings.rays),
    )
    given = {name: given_as(rig) for name, rig in zip(names, rigs, strict=True)}
    # A path says more than the name within the file.
    description = {**frames.description, "scenario": world.name if world is scenario else str(scenario)}
    return Task(frames, dict(zip(names, names, strict=True)), given, frames.sensors, description)


def _recording(rigs: Sequence[AnyRig], frames: FrameSource, settings: Settings) -> Task:
    names = distinct_names(rigs or list(frames.rigs))
    clouds = _clouds(names, frames)
    named = dict(zip(names, rigs, strict=True)) if rigs else {}
    given = {name: given_as(named[name]) if named else None for name in names}
    # A name that is in the recording may be a name only; any other has to be that of a rig.
    documents = {name: rig for name, rig in named.items() if is_document(rig) or name not in frames.rigs}
    sensors = {**frames.sensors, **{name: loaded(rig).sensors for name, rig in documents.items()}}
    return Task(frames, clouds, given, sensors, frames.description, settings.steps)


def _clouds(names: Sequence[str], frames: FrameSource) -> dict[str, str]:
    """Whose clouds each name means; the only rig of a recording goes by any name."""
    if len(names) == len(frames.rigs) == 1:
        return dict(zip(names, frames.rigs, strict=True))
    unknown = [name for name in names if name not in frames.rigs]
    if unknown:
        raise ValueError(f"no clouds of the rig {', '.join(unknown)}; the frames have {', '.join(frames.rigs)}")
    return dict(zip(names, names, strict=True))
