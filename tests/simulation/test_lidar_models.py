"""LiDAR models: keys of the sensor override keys of its model."""

import numpy as np
import pytest

from torchcover import Rig
from torchcover.simulation import Lidar, list_builtin_names
from torchcover.simulation.lidar import LidarModel

# Rows, lowest and highest elevation (degrees), columns, range (m): published figures, not read from our files.
PUBLISHED = {
    "hesai_at128": (128, -12.47, 12.93, 1200, 200),
    "hesai_pandar128": (128, -24.96, 14.45, 3600, 200),
    "hesai_pandar64": (64, -24.91, 14.87, 1800, 200),
    "innovusion_falcon": (60, -12.5, 12.5, 1500, 250),
    "ouster_os0_128": (128, -46.16, 44.3, 1024, 55),
    "ouster_os1_128": (128, -21.95, 20.47, 1024, 120),
    "ouster_os1_64": (64, -16.68, 16.73, 1024, 120),
    "velodyne_hdl32e": (32, -30.67, 10.67, 2168, 100),
    "velodyne_hdl64e": (64, -24.56, 1.96, 2083, 120),
    "velodyne_vlp16": (16, -15.0, 15.0, 1800, 100),
    "velodyne_vlp32c": (32, -25.0, 15.0, 1800, 200),
    "velodyne_vls128": (128, -25.0, 15.0, 1800, 300),
    "waymo_short_range": (200, -89.7, 29.7, 600, 20),
    "waymo_top": (64, -17.72, 2.21, 2650, 75),
}
RIG = """
name: r
sensors:
  - {{type: lidar, name: top, mount: {{}}, {keys}}}
"""


def sensor(**keys):
    return Lidar.model_validate({"name": "s", **keys})


def read(folder, keys):
    path = folder / "rig.yaml"
    path.write_text(RIG.format(keys=keys))
    return Rig.load(path).sensors[0]


def test_all_built_in_models_are_tested():
    assert list_builtin_names("lidars") == sorted(PUBLISHED)


@pytest.mark.parametrize("name", PUBLISHED)
def test_models_match_data_sheets_and_state_the_source(name):
    model = LidarModel.load(name)
    rows, lowest, highest, columns, range_m = PUBLISHED[name]
    elevations = model.compute_elevations_deg()
    assert model.name == name
    assert len(elevations) == rows
    assert elevations.min() == pytest.approx(lowest, abs=0.006)
    assert elevations.max() == pytest.approx(highest, abs=0.006)
    assert (model.columns, model.max_range_m) == (columns, range_m)
    assert any(word in model.description for word in ("/", "data sheets"))


@pytest.mark.parametrize("name", PUBLISHED)
def test_rows_are_sorted_and_different(name):
    steps = np.diff(LidarModel.load(name).compute_elevations_deg())
    assert (steps < 0).all() or (steps > 0).all()


def test_hesai_azimuth_offsets_have_the_opposite_sign():
    # Channel 8 of a Pandar64: elevation 1.676, offset 3.125 degrees clockwise.
    model = LidarModel.load("hesai_pandar64")
    row = int(np.argmin(np.abs(model.compute_elevations_deg() - 1.676)))
    assert model.azimuth_offsets_deg[row] == -3.125
    x, y, _ = model.compute_directions()[:, row, 900]
    assert np.rad2deg(np.arctan2(y, x)) == pytest.approx(-3.125 + 0.1, abs=1e-6)


def test_velodyne_rows_turn_as_in_the_manual():
    # VLP-32C, laser 0: elevation -25, azimuth offset +1.4 degrees clockwise.
    model = LidarModel.load("velodyne_vlp32c")
    assert model.azimuth_offsets_deg[int(np.argmin(model.compute_elevations_deg()))] == -1.4


def test_a_sensor_has_the_pattern_of_its_model():
    model = LidarModel.load("ouster_os1_64")
    lidar = sensor(model="ouster_os1_64", mount={"z_m": 2.0})
    np.testing.assert_array_equal(lidar.compute_directions(), model.compute_directions())
    assert (lidar.name, lidar.mount.z_m, lidar.min_range_m, lidar.max_range_m) == ("s", 2.0, 0.3, 120.0)


def test_keys_of_a_sensor_override_its_model():
    lidar = sensor(model="velodyne_vlp16", columns=900, max_range_m=30, range_noise_m=0.03, dropout=0.1)
    assert (lidar.columns, lidar.max_range_m, lidar.range_noise_m, lidar.dropout) == (900, 30.0, 0.03, 0.1)
    assert len(lidar.compute_elevations_deg()) == 16


@pytest.mark.parametrize(
    ("model", "keys", "rows_deg"),
    [
        ("hesai_pandar64", {"channels": 3, "vertical_fov_deg": (-10, 10)}, [-10, 0, 10]),
        ("hesai_pandar64", {"elevations_deg": (1, -1)}, [1, -1]),
        ("innovusion_falcon", {"elevations_deg": (1, -1)}, [1, -1]),
        ("innovusion_falcon", {"channels": 3}, [-12.5, 0, 12.5]),
    ],
)
def test_rows_of_a_sensor_replace_model_offsets(model, keys, rows_deg):
    lidar = sensor(model=model, **keys)
    assert (lidar.compute_elevations_deg().tolist(), lidar.azimuth_offsets_deg) == (rows_deg, None)


def test_azimuth_offsets_are_optional():
    lidar = sensor(model="hesai_pandar64", azimuth_offsets_deg=None)
    assert lidar.azimuth_offsets_deg is None
    assert len(lidar.compute_elevations_deg()) == 64


def test_expanding_the_model_keeps_the_sensor_equal():
    for model in ("ouster_os1_64", "innovusion_falcon"):
        lidar = sensor(model=model, columns=7)
        assert Lidar.model_validate(lidar.model_dump()) == lidar


def test_parsing_does_not_change_the_input():
    keys = {"name": "s", "model": "velodyne_vlp16"}
    Lidar.model_validate(keys)
    assert keys == {"name": "s", "model": "velodyne_vlp16"}


def test_models_may_be_files_relative_to_rigs(tmp_path):
    (tmp_path / "own.yaml").write_text(
        "{name: own, elevations_deg: [0, -5], horizontal_fov_deg: 90, columns: 4, max_range_m: 9}"
    )
    assert read(tmp_path, "model: own.yaml").compute_elevations_deg().tolist() == [0, -5]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("model: vlp16", r"sensors\.0: model: 'vlp16' is neither .* built-in lidars; is .*velodyne_vlp16"),
        ("model: none.yaml", r"sensors\.0: model: .*none\.yaml: no such file"),
        ("model: 16", r"sensors\.0\.model: .*text is needed; got 16"),
        ("model: hesai_pandar64, channels: 8", r"sensors\.0: the rows are missing"),
        ("model: hesai_pandar64, azimuth_offsets_deg: [1]", "one for each of the 64 rows is needed; got 1"),
        ("model: velodyne_vlp16, max_range_m: 0.2", r"min_range_m \(0\.4\) must be below"),
        ("model: velodyne_vlp16, colums: 9", r"sensors\.0\.colums: unknown key"),
        ("model: velodyne_vlp16, dropout: 1.1", r"dropout: .*a number of at most 1 is needed; got 1\.1"),
        ("model: velodyne_vlp16, dropout: -0.1", r"dropout: .*a number of at least 0"),
        ("model: velodyne_vlp16, range_noise_m: -1", r"range_noise_m: .*a number of at least 0"),
        ("model: velodyne_vlp16, range_noise_m: .nan", r"range_noise_m: .*finite"),
    ],
)
def test_a_wrong_sensor_is_named(tmp_path, keys, message):
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, keys)
    assert "\n" not in str(caught.value)


def test_a_wrong_model_file_is_named(tmp_path):
    (tmp_path / "own.yaml").write_text("{name: own, elevations_deg: [95], horizontal_fov_deg: 90, columns: 4}")
    message = r"sensors\.0: .*own\.yaml: max_range_m: a value is needed; the key is missing; elevations_deg\.0: .*90"
    with pytest.raises(ValueError, match=message):
        read(tmp_path, "model: own.yaml")
