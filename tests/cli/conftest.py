"""Fixtures of commands: the command in this process, and scenes that are fast to ray cast."""

import os
import sys
from pathlib import Path

import pytest

from torchcover.cli import app

# Prefixes of temporary files, which are no results.
TEMPORARY_PREFIXES = (".torchcover_", ".unfinished_")
opened = []


def record_opened(event, arguments):
    if event == "open" and isinstance(arguments[0], str | os.PathLike):
        path, mode, flags = arguments
        writes = any(letter in (mode or "") for letter in "wax+") or flags & (os.O_WRONLY | os.O_RDWR)
        if writes and not Path(path).is_dir():  # a folder is only opened for a file without a name
            opened.append(Path(path).absolute())


sys.addaudithook(record_opened)


@pytest.fixture
def torchcover(monkeypatch, capsys, tmp_path):
    """Run the command in an empty folder and check that it replaces files atomically; exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["torchcover", *map(str, arguments)])
        opened.clear()
        with pytest.raises(SystemExit) as stop:
            app.main()
        captured = capsys.readouterr()
        results = [path.relative_to(tmp_path) for path in opened if path.is_relative_to(tmp_path)]
        # The journal of a search grows line by line, so that a torn line is recognized.
        replaced = [path for path in results if path.name != "search.journal"]
        in_place = [path for path in replaced if not any(part.startswith(TEMPORARY_PREFIXES) for part in path.parts)]
        assert in_place == []
        return stop.value.code, captured.out, captured.err

    return run


@pytest.fixture
def scenes(tmp_path):
    """Folder with rig `low`, rig `both` with one more sensor, a different `low` in `other/`, and scenario `yard`."""
    pattern = "channels: 8, vertical_fov_deg: [-30, 0], horizontal_fov_deg: 90, columns: 30, max_range_m: 60"
    front = f"  - {{name: front, mount: {{x_m: 2.5, z_m: 0.8}}, {pattern}}}\n"
    rear = f"  - {{name: rear, mount: {{x_m: -2.5, z_m: 0.8, yaw_deg: 180}}, {pattern}}}\n"
    (tmp_path / "other").mkdir()
    (tmp_path / "low.yaml").write_text(f"name: low\nsensors:\n{front}")
    (tmp_path / "both.yaml").write_text(f"name: both\nsensors:\n{front}{rear}")
    (tmp_path / "other" / "low.yaml").write_text(f"name: low\nsensors:\n{rear}")
    (tmp_path / "yard.yaml").write_text(
        "name: yard\n"
        "ego: {shape: {type: box, size_m: [4, 2, 1]}, pose: {x_m: 1000, y_m: 500, yaw_deg: 90}}\n"
        "bodies:\n"
        "  - {name: ground, shape: {type: plane, size_m: [400, 400]}, poses: [{x_m: 1000, y_m: 500}]}\n"
        "actors:\n"
        # 20 m ahead of the ego and 5 m to its left.
        "  - {name: a, category: box, shape: {type: box, size_m: [4, 2, 1]}, pose: {x_m: 995, y_m: 520, yaw_deg: 90}}\n"
        "  - {name: b, category: far, shape: {type: box, size_m: [4, 2, 1]}, pose: {x_m: 1000, y_m: 100}}\n"
    )
    return tmp_path


@pytest.fixture(autouse=True)
def _maps(request):
    """Replace maps by blank images, unless a test has `drawn_maps`; tests/report checks the maps."""
    if "drawn_maps" not in request.fixturenames:
        request.getfixturevalue("blank_maps")
