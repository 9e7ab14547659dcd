"""What frames depend on: it changes with what is in the documents and files, and with nothing else."""

import json
import os
import shutil

import numpy as np
import pytest

from torchcover.data import RecordedFrames, RigSubset, SimulatedFrames
from torchcover.simulation.simulated_frames import create_reference_sensor

RIG = (
    "name: low\nsensors:\n  - {name: front, mount: {x_m: 2.5, z_m: 0.8}, channels: 8, vertical_fov_deg: [-30, 0], "
    "horizontal_fov_deg: 90, columns: 30, max_range_m: 60}\n"
)
VAN = "name: van\nparts:\n  - {name: body, shape: {type: box, size_m: [5, 2, 2]}}\n"
DRIVE = "time_s,x_m,y_m,z_m,yaw_deg\n0,0,0,0,0\n1,5,0,0,0\n"


def written(folder):
    (folder / "low.yaml").write_text(RIG)
    (folder / "van.yaml").write_text(VAN)
    (folder / "drive.csv").write_text(DRIVE)
    (folder / "road.yaml").write_text(
        "name: road\n"
        f"ego: {{shape: {{type: vehicle, vehicle: {folder / 'van.yaml'}}}, trajectory: drive.csv}}\n"
        "bodies: [{name: ground, shape: {type: plane, size_m: [400, 400]}}]\nduration_s: 1.0\n"
    )
    return folder


def content(folder, **settings):
    settings = {"num_frames": 2, "frame_interval_s": 0.1, **settings}
    return json.dumps(SimulatedFrames(folder / "road.yaml", folder / "low.yaml", **settings).collect_content())


def test_content_of_simulations_is_that_of_files(tmp_path):
    before = content(written(tmp_path))
    for name, old, new in (
        ("low.yaml", "z_m: 0.8", "z_m: 0.9"),
        ("van.yaml", "size_m: [5", "size_m: [6"),
        ("drive.csv", "1,5,0", "1,6,0"),
        ("road.yaml", "[400, 400]", "[400, 401]"),
    ):
        (tmp_path / name).write_text((tmp_path / name).read_text().replace(old, new))
        assert content(tmp_path) != before, name
        assert content(written(tmp_path)) == before
    for changed in (
        {"seed": 1},
        {"frame_interval_s": 0.2},
        {"reference_sensor": create_reference_sensor(num_rays=999)},
        {"boxes": True},
    ):
        assert content(tmp_path, **changed) != before
    assert content(tmp_path, num_frames=9) == before


def test_content_ignores_paths_and_descriptions(tmp_path):
    before = content(written(tmp_path))
    (tmp_path / "moved").mkdir()
    after = written(tmp_path / "moved")
    (after / "low.yaml").write_text(RIG.replace("name: low\n", "name: low\ndescription: better told\n"))
    assert content(after) == before


def test_traffic_has_its_vehicles_in_it(monkeypatch):
    frames = SimulatedFrames("urban", "front_roof_32", num_frames=1)
    before = frames.collect_content()
    monkeypatch.setattr("torchcover.simulation.traffic.kind.hash_builtin_documents", lambda _: {"van": "larger"})
    assert frames.collect_content()["scenario"]["traffic"].pop("vehicles") == {"van": "larger"}
    assert len(before["scenario"]["traffic"].pop("vehicles")) > 5
    assert before["scenario"]["traffic"]["type"] == "urban"


@pytest.mark.parametrize("change", ["size", "time", "name", "pose"])
def test_content_of_recordings_is_names_times_poses(tmp_path, change):
    folder = tmp_path / "recording"
    for place in ("rigs/a", "rigs/b", "reference"):
        (folder / place).mkdir(parents=True)
        np.save(folder / place / "f1.npy", np.zeros((4, 3), dtype=np.float32))
    before = RigSubset(RecordedFrames(folder), {"A": "a"}).collect_content()
    shutil.move(folder, tmp_path / "elsewhere")
    folder = tmp_path / "elsewhere"
    (folder / "out").mkdir()
    (folder / "out" / "checkpoint.npz").touch()  # results are no part of it
    assert RigSubset(RecordedFrames(folder), {"A": "a"}).collect_content() == before
    assert RigSubset(RecordedFrames(folder), {"A": "b"}).collect_content() != before
    cloud = folder / "rigs" / "a" / "f1.npy"
    if change == "size":
        stamp = cloud.stat()
        np.save(cloud, np.zeros((5, 3), dtype=np.float32))
        os.utime(cloud, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    elif change == "time":
        os.utime(cloud, ns=(0, cloud.stat().st_mtime_ns + 1))
    elif change == "name":
        for place in ("rigs/a", "rigs/b", "reference"):
            (folder / place / "f1.npy").rename(folder / place / "f2.npy")
    else:
        rows = "[[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
        (folder / "frames.yaml").write_text(f"reference: {{vehicle_T_sensor: {rows}}}\n")
    assert RigSubset(RecordedFrames(folder), {"A": "a"}).collect_content() != before
