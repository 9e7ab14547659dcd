"""Command `rig`: the rig of a simulated recording is recovered."""

import numpy as np
import yaml

from torchcover import Rig


def test_rig_of_a_simulated_recording_is_recovered(torchcover, scenes, tmp_path):
    recording, rig_file = tmp_path / "recording", tmp_path / "rig.yaml"
    few = ("--scenario", scenes / "yard.yaml", "--num-frames", 2, "--num-rays", 64)
    torchcover("record", scenes / "both.yaml", *few, "--out", recording)
    code, printed, error = torchcover("rig", "--frames", recording)
    assert (code, error) == (0, "")
    rig_file.write_text(printed)
    rig, true = Rig.load(rig_file), Rig.load(scenes / "both.yaml")
    assert rig.name == "recording"
    assert "7 rows (with returns), 30 columns" in rig.description
    for lidar, of in zip(rig.sensors, true.sensors, strict=True):
        # Behind the vehicle there is nothing that a level ray hits.
        returned_deg = np.sort(of.compute_elevations_deg())[::-1][of.name == "rear" :]
        np.testing.assert_allclose(lidar.compute_elevations_deg(), returned_deg, atol=5e-4)
        assert (lidar.name, lidar.columns, lidar.horizontal_fov_deg) == (of.name, 30, 90.0)
        np.testing.assert_allclose(lidar.mount.to_matrix(), of.mount.to_matrix(), atol=1e-6)
        assert lidar.max_range_m <= 60.1
    assert torchcover("evaluate", rig_file, *few, "--set", "cell_m=1", "--out", tmp_path / "out")[0] == 0
    code, printed, _ = torchcover("rig", "--frames", recording, "--sensors", "rear", "--lidar", "rear=velodyne_vlp16")
    (sensor,) = yaml.safe_load(printed)["sensors"]
    assert (code, sensor["name"], sensor["model"]) == (0, "rear", "velodyne_vlp16")


def test_rig_rejects_invalid_options(torchcover, scenes, tmp_path):
    for options, message in (
        (("--frames", tmp_path / "none"), "none: no such recording"),
        (("--frames", tmp_path, "--lidar", "roof"), "--lidar roof: NAME=VALUE is needed, as in LIDAR_TOP="),
        (("--frames", tmp_path, "--set", "recording.format=bag"), "no such format of recordings; there are"),
    ):
        code, printed, error = torchcover("rig", *options)
        assert (code, printed, len(error.splitlines())) == (2, "", 1)
        assert message in error
