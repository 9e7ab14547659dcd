"""`torchcover rig`."""

from collections.abc import Sequence
from pathlib import Path

import typer

from torchcover.files import as_yaml
from torchcover.recordings import open_recording
from torchcover.simulation import rig_document


def run(frames: Path, recording_format: str | None, sensors: Sequence[str], lidars: Sequence[str]) -> None:
    """Print the rig of a recording as YAML.

    Raises:
        ValueError: What is no SENSOR=MODEL, or as `open_recording` and `rig_document`.
        FileNotFoundError: No such recording or model.
    """
    models = dict(_pair(text) for text in lidars)
    names = [name for of in sensors for name in of.split(",")]
    rig = rig_document(open_recording(frames, recording_format), sensors=names or None, models=models)
    typer.echo(as_yaml(rig), nl=False)


def _pair(text: str) -> tuple[str, str]:
    sensor, equals, model = text.partition("=")
    if not (sensor and equals and model):
        raise ValueError(f"--lidar {text}: SENSOR=MODEL is needed, as in LIDAR_TOP=velodyne_hdl32e")
    return sensor, model
