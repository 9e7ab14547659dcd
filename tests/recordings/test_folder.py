"""Plain folders with optional files, and their faults."""

import pickle

import numpy as np
import pytest
import torch

from tests.recordings.drives import Drive
from tests.recordings.layouts import BOX, HALF_TURN, POSE, plain_folder, pose_row, table
from torchcover.data import BadFrameError, RecordedFrames, open_recording

CLOUD = np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 0.5]])


def clouds(folder, **places):
    """Write frames f2 and f10 into each of some folders (`sensors__roof` is `sensors/roof`)."""
    for place, cloud in places.items():
        path = folder / place.replace("__", "/")
        path.mkdir(parents=True)
        for name in ("f2", "f10"):
            np.save(path / f"{name}.npy", cloud)
    return folder


def driven(folder, times=(0.0, 0.5), **others):
    rows = [[name, time, *pose_row(np.eye(4))] for name, time in zip(("f2", "f10"), times, strict=True)]
    table(folder / "poses.csv", ("frame", "time_s", *POSE, *others), rows)
    return folder


def test_plain_folder_preserves_names_boxes_and_ego_box(tmp_path):
    recording = pickle.loads(pickle.dumps(open_recording(plain_folder(Drive(), tmp_path))))
    assert recording.sensors == ("left", "right")
    assert recording.reference_sensors == ()
    assert recording.ego_box.upper_m == (2.0, 1.0, 1.5)
    assert (recording.read_boxes(1).ids, recording.read_boxes(1).categories) == (("car",), ("car, red",))


def test_points_below_minimum_range_are_no_returns(tmp_path):
    near = np.array([[0.4, 0.0, 0.0], [0.5, 0.0, 0.0], [0.0, -0.49, 0.0], [np.nan, 0.0, 0.0]])
    clouds(tmp_path, sensor=near, reference=CLOUD)
    (tmp_path / "frames.yaml").write_text(
        f"sensor: {{vehicle_T_sensor: {HALF_TURN.tolist()}, min_range_m: 0.5, flip_y: false}}"
    )
    frame = RecordedFrames(tmp_path)[0]
    np.testing.assert_allclose(frame.sensor, [[-0.5, 0.0, 2.0]], atol=1e-6)
    assert (frame.counts["sensor_no_return"], frame.counts["sensor_nonfinite"]) == (2, 1)


def test_weights_follow_their_reference_points(tmp_path):
    clouds(tmp_path, sensor=CLOUD, reference=CLOUD)
    points = np.array([[0.0, 0, 0], [9.0, 0, 0], [np.nan, 0, 0], [0.5, 0, 0.5], [7.0, 0, 0]])
    for name in ("f2", "f10"):
        (tmp_path / "reference" / f"{name}.npy").unlink()
        np.savez(tmp_path / "reference" / f"{name}.npz", points=points, weights=np.arange(1.0, 6.0))
    assert RecordedFrames(tmp_path)[0].reference_weights is None
    (tmp_path / "frames.yaml").write_text(
        "{reference: {area_weights: true}, vehicle: {lower_m: [-1, -1, 0], upper_m: [1, 1, 1]}}"
    )
    frames = RecordedFrames(tmp_path)
    assert frames.metadata.has_area_weights
    assert frames[1].reference[:, 0].tolist() == [9.0, 7.0]
    assert frames[1].reference_weights.tolist() == [2.0, 5.0]
    assert frames[1].reference_weights.dtype == torch.float32


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": CLOUD}, r"the arrays points and weights are needed; got points$"),
        ({"points": CLOUD, "weights": np.ones(3)}, r"one weight for each point is needed; got 3 for 2"),
        ({"points": CLOUD, "weights": np.array([1.0, 0.0])}, r"weights have to be positive and finite; 1 of 2 are not"),
        (
            {"points": CLOUD, "weights": np.array([np.nan, np.inf])},
            r"weights have to be positive and finite; 2 of 2 are not",
        ),
        ({"points": CLOUD, "weights": np.ones((2, 1))}, r"weights: shape \(N,\) of float.* got \(2, 1\)"),
    ],
)
def test_bad_weights_are_a_bad_frame(tmp_path, arrays, message):
    clouds(tmp_path, sensor=CLOUD, reference=CLOUD)
    (tmp_path / "frames.yaml").write_text("reference: {area_weights: true}")
    with pytest.raises(BadFrameError, match=r"f2\.npy: weights need a \.npz"):
        RecordedFrames(tmp_path)[0]
    (tmp_path / "reference" / "f2.npy").unlink()
    np.savez(tmp_path / "reference" / "f2.npz", **arrays)
    with pytest.raises(BadFrameError, match=rf"reference.f2\.npz: {message}"):
        RecordedFrames(tmp_path)[0]


def test_dependent_frames_share_a_block_index(tmp_path):
    driven(clouds(tmp_path, sensor=CLOUD, reference=CLOUD))
    assert [frame.block_index for frame in RecordedFrames(tmp_path)] == [0, 1]
    text = (tmp_path / "poses.csv").read_text().splitlines()
    (tmp_path / "poses.csv").write_text("\n".join([text[0] + ",block_index", *(line + ",7" for line in text[1:])]))
    assert [frame.block_index for frame in RecordedFrames(tmp_path)] == [7, 7]
    (tmp_path / "poses.csv").write_text("\n".join([text[0] + ",block_index", *(line + ",7.5" for line in text[1:])]))
    with pytest.raises(ValueError, match=r"poses\.csv: block_index: whole numbers are needed; got 7\.5"):
        RecordedFrames(tmp_path)


HEADER = "frame,time_s,x_m,y_m,z_m,qw,qx,qy,qz"
ROWS = "\nf2,0,0,0,0,1,0,0,0\nf10,1,0,0,0,1,0,0,0"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"an empty file \(0 bytes\)"),
        ("\n\n", r"the first line has to name the columns .*; missing: frame, time_s, x_m"),
        (HEADER[:-3] + ROWS, r"missing: qz$"),
        (HEADER + ",roll" + ROWS, r"unknown: roll$"),
        (HEADER + ",qw" + ROWS, r"there twice: qw$"),
        (HEADER, r"each frame needs one row; 2 are missing \(f2, f10\)"),
        (HEADER + ROWS[:20], r"1 are missing \(f10\)"),
        (HEADER + ROWS + ROWS[:20], r"1 are repeated \(f2\)"),
        (HEADER + ROWS + "\nf11,2,0,0,0,1,0,0,0", r"1 are unknown \(f11\)"),
        (HEADER + ROWS + ",9", r"line 3: 9 columns are needed .* got 10"),
        (HEADER + ROWS.replace("f10,1", "f10,nan"), r"line 3: time_s: a finite number is needed; got 'nan'"),
        (HEADER + ROWS.replace("f10,1,0", "f10,1,east"), r"line 3: x_m: a finite number is needed; got 'east'"),
        (
            HEADER + ROWS.replace("f10,1,0,0,0,1", "f10,1,0,0,0,2"),
            r"frame f10: qw, .* has norm 1; got 2; 1 of ",
        ),
        (HEADER + ROWS.replace("f10,1", "f10,0"), r"times have to ascend; 1 do not, the first after frame 0"),
        (HEADER + '\n"f2', r"line 2: not CSV \(unexpected end of data\)"),
    ],
)
def test_bad_pose_table_names_file_and_field(tmp_path, text, message):
    (clouds(tmp_path, sensor=CLOUD, reference=CLOUD) / "poses.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"poses\.csv: .*{message}") as caught:
        RecordedFrames(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1,2,3,4,5,6,inf,a,car", r"line 2: yaw_rad: a finite number is needed; got 'inf'"),
        ("1,2,3,4,-5,6,0,a,car", r"size_m: 1 of 1 boxes have a length, width or height that is not positive"),
        ("1,2,3,4,5,6,0,a,car\n1,2,3,4,5,6,0,a,car", r"id: every object needs its own; a appears more than once"),
        ("1,2,3,4,5,6,0,a", r"line 2: 9 columns are needed"),
    ],
)
def test_bad_boxes_are_a_bad_frame(tmp_path, row, message):
    clouds(tmp_path, sensor=CLOUD, reference=CLOUD)
    for name in ("f2", "f10"):
        table(tmp_path / "boxes" / f"{name}.csv", (*BOX, "id", "category"), [])
    assert len(RecordedFrames(tmp_path)[0].boxes) == 0
    with (tmp_path / "boxes" / "f2.csv").open("a") as file:
        file.write(row)
    with pytest.raises(BadFrameError, match=rf"^f2 \(frame 0\): .*f2\.csv: {message}"):
        RecordedFrames(tmp_path)[0]
    table(tmp_path / "boxes" / "f2.csv", (*BOX, "sampled_points", "id", "category"), [(*[1.0] * 7, 0.5, "", "")])
    with pytest.raises(BadFrameError, match=r"f2\.csv: sampled_points: whole numbers are needed; got 0\.5"):
        RecordedFrames(tmp_path)[0]
    (tmp_path / "boxes" / "f2.csv").unlink()
    with pytest.raises(ValueError, match=r"1 missing in boxes/ \(f2\)"):
        RecordedFrames(tmp_path)


def test_sensors_are_chosen_by_folder_name(tmp_path):
    clouds(tmp_path, sensors__roof=CLOUD, sensors__left=CLOUD + 10.0, reference=CLOUD)
    assert RecordedFrames(tmp_path).metadata.rigs == ("recording",)
    assert len(RecordedFrames(tmp_path)[0].sensor) == 4
    assert RecordedFrames(tmp_path, rigs={"one": ["left"]})[0].sensor.tolist() == (CLOUD + 10.0).tolist()
    (tmp_path / "sensors" / "left").rename(tmp_path / "sensors" / "reference")
    with pytest.raises(ValueError, match=r"sensors: a sensor called reference; each has a folder sensors/NAME/"):
        RecordedFrames(tmp_path)


def test_extrinsics_are_given_once(tmp_path):
    clouds(tmp_path, sensors__roof=CLOUD, reference=CLOUD)
    rows = [[name, *pose_row(HALF_TURN)] for name in ("f2", "f10")]
    table(tmp_path / "reference" / "poses.csv", ("frame", *POSE), rows)
    np.testing.assert_allclose(RecordedFrames(tmp_path)[0].reference, CLOUD * [-1, -1, 1] + [0, 0, 2], atol=1e-6)
    (tmp_path / "frames.yaml").write_text(f"reference: {{vehicle_T_sensor: {HALF_TURN.tolist()}}}")
    with pytest.raises(ValueError, match=r"reference\.vehicle_T_sensor: reference/poses\.csv has it too; keep one"):
        RecordedFrames(tmp_path)
    (tmp_path / "frames.yaml").write_text("reference: {min_range_m: 1}")
    assert len(RecordedFrames(tmp_path)[0].reference) == 2


def test_accumulated_reference_of_a_folder_needs_poses(tmp_path):
    clouds(tmp_path, sensor=CLOUD)
    with pytest.raises(ValueError, match=r"no reference can be accumulated because .* has no times of its scans"):
        RecordedFrames(tmp_path)
    assert len(RecordedFrames(driven(tmp_path))[0].reference) == 0  # a vehicle that stands sees nothing from elsewhere
    ahead = np.eye(4)
    ahead[0, 3] = 4.0
    rows = [["f2", 0.0, *pose_row(np.eye(4))], ["f10", 0.5, *pose_row(ahead)]]
    table(tmp_path / "poses.csv", ("frame", "time_s", *POSE), rows)
    assert len(RecordedFrames(tmp_path)[0].reference) > 0
