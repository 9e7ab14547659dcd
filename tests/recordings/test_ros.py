"""ROS bags: layouts of clouds, point times, trees of frames, and inconsistent bags."""

import os

import lz4.frame
import numpy as np
import pytest
from rosbags import rosbag1
from rosbags.rosbag2.writer import zstd

from tests.recordings import bags
from tests.recordings.bags import T0_NS, bag, cloud, link, made, odometry, points, posed, tree
from tests.recordings.drives import Drive
from torchcover.data import RecordedFrames, open_recording
from torchcover.files import BadFileError
from torchcover.geometry import build_transform, convert_euler_to_rotation, invert, transform_points
from torchcover.recordings.formats.bag import Bag
from torchcover.recordings.formats.ros import RosBag
from torchcover.recordings.formats.ros_poses import FrameTree
from torchcover.recordings.vehicle_cloud import transform_to_vehicle

CORNERS_M = np.array([[5.0, 1.0, 0.5], [8.0, -2.0, 0.25], [-4.0, 0.5, 1.0], [6.0, 6.0, 2.0]])
FAR_CORNERS_M = CORNERS_M + np.array([1e5, -4e5, 0.0])
mount = build_transform(convert_euler_to_rotation(25.0, 4.0, -3.0), [1.0, 0.2, 1.6])


def static(*links):
    return "/tf_static", T0_NS, tree(*links)


MOUNTED = [static(link("base_link", "lidar", mount))]
STEP_NS = 100_000_000


def clouds(message=None, count=2):
    """A cloud every 0.1 s."""
    made_of = message or (lambda time_ns: cloud(points(CORNERS_M), time_ns, "lidar"))
    return [("/lidar", T0_NS + k * STEP_NS, made_of(T0_NS + k * STEP_NS)) for k in range(count)]


def pose_at(seconds):
    """Fast, and in a bend."""
    yaw_deg = 30.0 * np.asarray(seconds)
    flat = np.zeros_like(yaw_deg)
    return build_transform(
        convert_euler_to_rotation(yaw_deg, flat, flat), np.stack([1e5 + 20.0 * seconds, flat - 4e5, flat], axis=-1)
    )


def driven(count=60, every_ns=10_000_000):
    return [
        ("/odom", T0_NS + k * every_ns, odometry(pose_at(k * every_ns * 1e-9), T0_NS + k * every_ns))
        for k in range(count)
    ]


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_clouds_may_have_padding_rows_and_big_endian(tmp_path, kind, order):
    columns = {"ring": np.arange(6, dtype="u2"), "x": np.arange(6), "y": -np.arange(6), "z": np.full(6, 0.5)}
    columns |= {axis: columns[axis].astype(kind) for axis in "xyz"}
    columns["y"][3] = np.nan
    for axis in "xyz":
        columns[axis][5] = 0.0

    def organised(time_ns):
        return cloud(columns, time_ns, "lidar", height=2, gap=3, end=5, order=order)

    scan = RosBag(bag(tmp_path / "a", MOUNTED + clouds(organised))).read_scan("lidar", 0)
    stored_m = np.stack([columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(scan.points_m, stored_m)
    assert scan.points_m.dtype == np.dtype(kind)
    seen = transform_to_vehicle(scan)
    assert seen.excluded_counts == {"nonfinite": 1, "no_return": 1}
    np.testing.assert_allclose(seen.points_m, transform_points(mount, stored_m[[0, 1, 2, 4]]), atol=1e-6)


@pytest.mark.parametrize(("height", "row_step"), [(1, 0), (1, 36), (1, 10**6), (2, 12)])
def test_a_cloud_without_gaps_needs_no_row_step(tmp_path, height, row_step):
    path = other(tmp_path / "a", height=height, width=4 // height, row_step=row_step)
    np.testing.assert_array_equal(RosBag(path).read_scan("lidar", 1).points_m, CORNERS_M.astype("f4"))


@pytest.mark.parametrize("ending", ["-wal", "-journal"])
def test_messages_in_a_journal_are_not_lost(tmp_path, ending):
    path = bag(tmp_path / "a", MOUNTED + clouds(), "sqlite3")
    (path / f"a.db3{ending}").touch()
    assert len(RosBag(path).frame_names) == 2
    (path / f"a.db3{ending}").write_bytes(b"more")
    for opened in (path, path / "a.db3"):
        with pytest.raises(BadFileError, match=rf"in a.db3{ending} only, .* `sqlite3 a.db3 'PRAGMA quick_check'`"):
            open_recording(opened)


@pytest.mark.parametrize(
    ("field", "stored"),
    [
        ("t", lambda offset_ns, _: offset_ns.astype("u4")),
        ("time", lambda offset_ns, _: (offset_ns * 1e-9).astype("f4")),
        ("timestamp", lambda offset_ns, time_ns: (offset_ns + time_ns) * 1e-9),
        ("timestamp", lambda offset_ns, time_ns: (offset_ns + time_ns).astype("f8")),
        ("time_stamp", lambda offset_ns, _: offset_ns.astype("i4")),
    ],
)
def test_points_are_compensated_to_the_frame_time(tmp_path, field, stored):
    check_points_are_moved(tmp_path, field, stored)


@pytest.mark.parametrize(
    ("stored", "words"),
    [
        (
            lambda offset_ns, _: (offset_ns // 1000).astype("u4"),
            r"\(u4\) span 110000 where .* 0.1 s apart: .* us",
        ),
        (lambda offset_ns, _: (offset_ns * 1e-6).astype("f4"), "span 110 .* read as ms"),
        (lambda offset_ns, _: (offset_ns * 1e-3).astype("f4"), r"\(f4\) .* read as us"),
        (lambda offset_ns, time_ns: (offset_ns + time_ns) * 1e-3, r"\(f8\) .* read as us"),
        (lambda offset_ns, time_ns: (offset_ns + time_ns) * 1e-6, "read as ms"),
        (lambda offset_ns, _: (offset_ns / STEP_NS).astype("f4"), "read as shares of the scan period"),
    ],
)
def test_point_time_unit_follows_from_scan_period(tmp_path, stored, words):
    with pytest.warns(UserWarning, match=f"lidar: the point times .*{words}; choose another by"):
        check_points_are_moved(tmp_path, "t", stored)


@pytest.mark.parametrize(
    "stored",
    [
        lambda offset_ns, _: (offset_ns // 10_000).astype("u2"),  # 10 us
        lambda offset_ns, _: (offset_ns // 1000 + 5_000_000).astype("u4"),  # since another instant
        lambda offset_ns, _: (offset_ns / STEP_NS * 36000).astype("u2"),  # an angle
    ],
)
def test_point_times_without_plausible_unit_are_refused(tmp_path, stored):
    offset_ns = np.linspace(0, STEP_NS, 4)

    def timed(time_ns):
        return cloud(points(CORNERS_M, t=stored(offset_ns, time_ns)), time_ns, "lidar")

    path = bag(tmp_path / "a", MOUNTED + driven() + clouds(timed, 3))
    with pytest.raises(
        BadFileError, match=r"lidar: .*'t'.* no unit of s, ms, us, ns .* --set recording\.point_time_unit=UNIT \(s, ms"
    ):
        RosBag(path)
    assert RosBag(path, point_time_unit="none").read_scan("lidar", 1).offsets_s is None
    with pytest.raises(ValueError, match="point_time_unit: one of s, ms, us, ns, scan_share, none is needed; got 'h'"):
        RosBag(path, point_time_unit="h")


def test_point_times_over_part_of_a_scan_warn(tmp_path):
    def timed(time_ns):
        return cloud(points(CORNERS_M, t=np.array([0, 1e7, 2e7, 2.5e7], "u4")), time_ns, "lidar")

    path = bag(tmp_path / "a", MOUNTED + driven() + clouds(timed, 3))
    with pytest.warns(UserWarning, match="25% of the 0.1 s between scans; they are read as ns"):
        recording = RosBag(path)
    np.testing.assert_allclose(recording.read_scan("lidar", 1).offsets_s, [0, 0.01, 0.02, 0.025])


def check_points_are_moved(tmp_path, field, stored):
    world_m = transform_points(pose_at(0.15), np.repeat(CORNERS_M, 50, axis=0) * np.linspace(0.5, 3.0, 200)[:, None])
    offset_ns = np.linspace(-20_000_000, 90_000_000, 200).round().astype(np.int64)
    if field == "t":
        offset_ns += 20_000_000

    def measured(time_ns):
        world_T_sensor = pose_at((time_ns - T0_NS + offset_ns) * 1e-9) @ mount
        seen_m = np.einsum("nij,nj->ni", invert(world_T_sensor), np.c_[world_m, np.ones(200)])[:, :3]
        seen_m[7] = 0.0
        return cloud(points(seen_m, **{field: stored(offset_ns, time_ns)}), time_ns, "lidar")

    recording = RosBag(bag(tmp_path / "a", MOUNTED + driven() + clouds(measured, 3)))
    for index in range(3):
        scan = recording.read_scan("lidar", index)
        assert (scan.points_m[7] == 0).all()  # what never came back is still at the sensor
        there_m = transform_points(recording.get_world_T_vehicle(index) @ scan.vehicle_T_sensor, scan.points_m)
        np.testing.assert_allclose(np.delete(there_m, 7, axis=0), np.delete(world_m, 7, axis=0), atol=1e-3)


def test_clouds_are_compensated_to_the_frame_time(tmp_path):
    def late(time_ns):
        world_T_sensor = pose_at((time_ns - T0_NS) * 1e-9 + 0.04) @ mount
        return cloud(points(transform_points(invert(world_T_sensor), FAR_CORNERS_M)), time_ns + 40_000_000, "lidar")

    second = [("/b", time_ns + 40_000_000, message) for _, time_ns, message in clouds(late, 4)]
    recording = RosBag(bag(tmp_path / "a", MOUNTED + driven() + clouds(count=3) + second))
    assert recording.sensors == ("lidar", "b")
    frame = RecordedFrames(recording)[2]
    others_m = transform_points(invert(recording.get_world_T_vehicle(2)), FAR_CORNERS_M)
    np.testing.assert_allclose(frame.sensor.numpy()[4:], others_m, atol=1e-3)
    np.testing.assert_allclose(recording.get_world_T_vehicle(2), pose_at(0.2), atol=1e-9)
    chosen = RecordedFrames(recording, rigs={"b": ("b",)})[2]
    np.testing.assert_array_equal(chosen.sensor, frame.sensor[4:])


def test_odometry_may_refer_to_another_frame(tmp_path):
    vehicle_T_imu = build_transform(convert_euler_to_rotation(90.0, 0.0, 0.0), [-1.0, 0.5, 0.3])
    mounted = [static(link("base_link", "/lidar", mount), link("base_link", "imu", vehicle_T_imu))]
    measured = [
        ("/odom", T0_NS + k * STEP_NS, odometry(pose_at(0.1 * k) @ vehicle_T_imu, T0_NS + k * STEP_NS, "imu"))
        for k in range(2)
    ]
    recording = RosBag(bag(tmp_path / "a", mounted + measured + clouds()))
    np.testing.assert_allclose(recording.get_world_T_vehicle(1), pose_at(0.1), atol=1e-9)


def test_transforms_lead_to_the_continuous_odom_frame(tmp_path):
    jump = [link("map", "odom", pose_at(7.0), T0_NS + k * STEP_NS) for k in range(2)]
    here = [link("odom", "footprint", pose_at(0.1 * k), T0_NS + k * STEP_NS) for k in range(2)]
    raised = build_transform(np.eye(3), [0.0, 0.0, 0.3])
    mounted = [static(link("base_link", "lidar", mount), link("footprint", "base_link", raised))]
    moved = [("/tf", T0_NS + k * STEP_NS, tree(jump[k], here[k])) for k in range(2)]
    recording = RosBag(bag(tmp_path / "a", mounted + moved + clouds()))
    np.testing.assert_allclose(recording.get_world_T_vehicle(1), pose_at(0.1) @ raised, atol=1e-9)


def test_scans_beyond_the_poses_are_excluded(tmp_path):
    late = [(topic, time_ns + 5 * STEP_NS, message) for topic, time_ns, message in driven(30)]
    late = [("/odom", time_ns, odometry(pose_at(0.0), time_ns)) for _, time_ns, _ in late]
    recording = RosBag(bag(tmp_path / "a", MOUNTED + late + clouds(count=20)))
    # 0.5 to 0.79 s, and what a vehicle does within 0.15 s more.
    assert recording.times_s.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert recording.frame_names[0] == str(T0_NS + 4 * STEP_NS)


def test_choices_between_alternatives_warn(tmp_path):
    chart = [("/chart", T0_NS, cloud(points(CORNERS_M), T0_NS, "map"))]
    lost = [("/b", time_ns, cloud(points(CORNERS_M), time_ns, "nowhere")) for _, time_ns, _ in clouds(count=5)]
    goal = [("/goal", time_ns, posed(np.eye(4), time_ns)) for _, time_ns, _ in clouds(count=5)]
    path = bag(tmp_path / "a", MOUNTED + driven() + chart + lost + goal + clouds(count=5))
    with pytest.warns(UserWarning, match="excluded|are read from") as told:
        recording = open_recording(path)
    assert recording.sensors == ("lidar",)
    assert [str(one.message).removeprefix(f"{path}: ") for one in told] == [
        "excluded because of few messages: /chart",
        "excluded, since no static transform links to base_link the frame of /b (nowhere)",
        "poses are read from /odom (odometry of base_link), not from /goal (poses)",
    ]
    recording = RosBag(bag(tmp_path / "b", MOUNTED + clouds()), vehicle_frame="lidar")
    np.testing.assert_allclose(recording.read_scan("lidar", 0).vehicle_T_sensor, np.eye(4), atol=1e-12)


raised = build_transform(np.eye(3), [0.0, 0.0, 0.2])


def test_base_footprint_is_the_default_vehicle_frame(tmp_path):
    mounted = [static(link("base_link", "lidar", mount), link("base_footprint", "base_link", raised))]
    path = bag(tmp_path / "a", mounted + driven() + clouds())
    with pytest.warns(UserWarning, match="base_footprint is used as the vehicle frame, not base_link"):
        recording = RosBag(path)
    np.testing.assert_allclose(recording.read_scan("lidar", 0).vehicle_T_sensor, raised @ mount, atol=1e-12)
    np.testing.assert_allclose(recording.get_world_T_vehicle(1), pose_at(0.1) @ invert(raised), atol=1e-9)
    asked = RosBag(path, vehicle_frame="base_link")
    np.testing.assert_allclose(asked.read_scan("lidar", 0).vehicle_T_sensor, mount, atol=1e-12)


def moved_tree(k, *links):
    """What robot_state_publisher and odometry send 20 times a second."""
    return (
        "/tf",
        T0_NS + k * STEP_NS // 2,
        tree(*links, link("odom", "base_link", pose_at(0.05 * k), T0_NS + k * STEP_NS // 2)),
    )


@pytest.mark.parametrize("write", [bag, lambda path, messages: bags.bag1(path.with_suffix(".bag"), messages)])
def test_mounts_may_come_in_tf(tmp_path, write):
    # The head turns, and its camera with it.
    turned = [build_transform(convert_euler_to_rotation(float(k), 0.0, 0.0), [0.0, 0.0, 1.0]) for k in range(8)]
    moved = [
        moved_tree(
            k, link("base_link", "mast", raised), link("mast", "lidar", mount), link("base_link", "head", turned[k])
        )
        for k in range(8)
    ]
    head = [("/head", time_ns, cloud(points(CORNERS_M), time_ns, "head")) for _, time_ns, _ in clouds(count=3)]
    path = write(tmp_path / "a", moved + clouds(count=3) + head)
    with pytest.warns(UserWarning, match=r"excluded, .* the frame of /head"):
        recording = RosBag(path)
    np.testing.assert_allclose(recording.read_scan("lidar", 0).vehicle_T_sensor, raised @ mount, atol=1e-9)
    np.testing.assert_allclose(recording.get_world_T_vehicle(2), pose_at(0.2), atol=1e-6)


def test_mounts_may_come_from_the_user(tmp_path):
    # Odometry of the LiDAR frame, and a static transform to the vehicle.
    of_lidar = [
        ("/odom", time_ns, odometry(pose_at((time_ns - T0_NS) * 1e-9) @ mount, time_ns, "lidar"))
        for _, time_ns, _ in driven()
    ]
    beside = build_transform(np.eye(3), [0.0, 1.0, 0.0])
    second = [("/b", time_ns, cloud(points(CORNERS_M), time_ns, "second")) for _, time_ns, _ in clouds(count=3)]
    path = bag(
        tmp_path / "a",
        [static(link("rack", "lidar", raised), link("rack", "second", beside)), *of_lidar, *clouds(count=3), *second],
    )
    with pytest.raises(
        BadFileError, match=r"base_link of the vehicle is needed; there are lidar, rack, second: name one"
    ):
        RosBag(path)
    recording = RosBag(path, mounts={"lidar": mount})
    assert recording.sensors == ("b", "lidar")
    np.testing.assert_allclose(recording.read_scan("lidar", 0).vehicle_T_sensor, mount, atol=1e-12)
    np.testing.assert_allclose(
        recording.read_scan("b", 0).vehicle_T_sensor, mount @ invert(raised) @ beside, atol=1e-12
    )
    np.testing.assert_allclose(recording.get_world_T_vehicle(2), pose_at(0.2), atol=1e-9)
    told = RosBag(path, mounts={"lidar": mount, "b": raised})
    np.testing.assert_allclose(told.read_scan("b", 0).vehicle_T_sensor, raised, atol=1e-9)
    alone = RosBag(bag(tmp_path / "b", clouds()), mounts={"lidar": mount})
    np.testing.assert_allclose(alone.read_scan("lidar", 0).vehicle_T_sensor, mount, atol=1e-12)
    with pytest.raises(BadFileError, match=r"mount of roof: there are clouds of b, lidar"):
        RosBag(path, mounts={"roof": mount})


def test_files_of_ros_1_form_one_bag(tmp_path):
    (tmp_path / "drive").mkdir()
    bags.bag1(tmp_path / "drive" / "lidar.bag", MOUNTED + clouds(count=3))
    bags.bag1(tmp_path / "drive" / "poses.bag", driven())
    recording = open_recording(tmp_path / "drive")
    np.testing.assert_allclose(recording.get_world_T_vehicle(2), pose_at(0.2), atol=1e-9)
    whole = (tmp_path / "drive" / "lidar.bag").read_bytes()
    (tmp_path / "drive" / "lidar.bag").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadFileError, match=r"rosbag reindex lidar\.bag"):
        open_recording(tmp_path / "drive")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_opening_a_bag_reads_few_clouds(tmp_path, monkeypatch, storage):
    path = bag(tmp_path / "a", MOUNTED + driven(250) + clouds(count=200), storage)
    read = []
    messages = Bag.read_messages

    def counted(self, topic, *times):
        found = messages(self, topic, *times)
        read.extend([topic] * len(found))
        return found

    monkeypatch.setattr(Bag, "read_messages", counted)
    recording = RosBag(path)
    assert len(recording.frame_names) == 27  # 2.49 s of poses
    # One cloud is read for its frame, others within 1 s of the first and last pose for their stamps.
    assert read.count("/lidar") <= 1 + 11 + 20
    assert len(RosBag(next(path.glob("a.*"))).frame_names) == 27  # the file alone


def other(path, **changes):
    """A bag whose clouds have other sizes, or other fields."""

    def changed(time_ns):
        message = cloud(points(CORNERS_M), time_ns, "lidar")
        for name, value in changes.items():
            setattr(message, name, value)
        return message

    return bag(path, MOUNTED + clouds(changed))


def fields(*described):
    return [made("sensor_msgs/msg/PointField", *one, 1) for one in described]


XYZ = (("x", 0, 7), ("y", 4, 7))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"height": 2}, "2 rows of 48 bytes .4 points of 12. do not fit the 48 bytes"),
        ({"height": 2**31, "row_step": 2**31}, "do not fit the 48 bytes"),
        ({"width": 5}, "do not fit"),
        ({"width": 2**31, "row_step": 48, "point_step": 0}, "within the 0 bytes of a point"),
        ({"data": np.zeros(47, np.uint8)}, "do not fit the 47 bytes"),
        ({"fields": fields(*XYZ, ("z", 9, 7))}, "within the 12 bytes of a point are needed; one ends at byte 13"),
        (
            {"fields": fields(*XYZ, ("z", 8, 5))},
            r"x, y, z of float32 or float64 are needed; got x \(f4\), y \(f4\), z \(i4\)",
        ),
        ({"fields": fields(*XYZ)}, "fields x, y, z of float32"),
        ({"fields": []}, "got none"),
        ({"fields": fields(*XYZ, ("z", 8, 7), ("t", 8, 99))}, "within the 12 bytes"),
    ],
)
def test_inconsistent_clouds_are_bad_files(tmp_path, changes, told):
    recording = RosBag(other(tmp_path / "a", **changes))
    with pytest.raises(BadFileError, match=told):
        recording.read_scan("lidar", 0)


LOOP = link("a", "lidar", mount), link("b", "a", mount), link("a", "b", mount)
RING = link("b", "base_link", mount), link("base_link", "b", mount)
OTHER = link("base_link", "other", mount)
OTHER_CLOCK = [("/odom", T0_NS + k, odometry(mount, 5 * 10**9 + k)) for k in range(3)]
NOT_FINITE = build_transform(np.eye(3), [0.0, np.nan, 0.0])


@pytest.mark.parametrize(
    ("messages", "told"),
    [
        (MOUNTED, "PointCloud2 with messages is needed; there are /tf_static .tf2_msgs/msg/TFMessage."),
        (clouds(), "the frame base_footprint or base_link of the vehicle is needed; there are lidar"),
        ([static(OTHER), *clouds()], r"of /lidar \(lidar\); static ones are of base_link, other"),
        ([static(*LOOP), *clouds()], "base_link of the vehicle is needed; there are a, b, lidar"),
        ([static(link("base_link", "lidar", NOT_FINITE)), *clouds()], "lidar: three finite coordinates are needed"),
        ([*MOUNTED, *clouds(), ("/odom", T0_NS, odometry(NOT_FINITE, T0_NS))], "/odom: three finite"),
        ([*MOUNTED, *clouds(), ("/odom", T0_NS, odometry(mount, T0_NS, "wheel"))], r"odometry /odom \(wheel\)"),
        (
            [*MOUNTED, *clouds(), ("/tf", T0_NS, tree(*RING))],
            "/tf: b -> base_link: the transforms from base_link upward are a loop",
        ),
        (
            [*MOUNTED, *clouds(), *OTHER_CLOCK],
            "no scan lies between the first and the last pose of /odom .* clocks match",
        ),
        ([*MOUNTED, *clouds(), clouds()[1]], "times have to ascend"),
    ],
)
def test_inconsistent_bags_are_bad_files(tmp_path, messages, told):
    path = bag(tmp_path / "a", messages)
    with pytest.raises(BadFileError, match=told) as error:
        RosBag(path)
    assert str(error.value).startswith(f"{path}: ")
    assert str(error.value).count(str(path)) == 1


def two_parents(odom_every, map_every):
    """`odom -> base_link`, and `map -> base_link`, which is elsewhere, each at 20 Hz or more rarely."""
    elsewhere = build_transform(np.eye(3), [0.3, 0.25, 0.0])
    messages = []
    for k in range(12):
        time_ns = T0_NS + k * STEP_NS // 2
        if k % odom_every == 0:
            messages.append(("/tf", time_ns, tree(link("odom", "base_link", pose_at(0.05 * k), time_ns))))
        if k % map_every == 0:
            other_ns = time_ns + 3_000_000
            moved = elsewhere @ pose_at(0.05 * k + 0.003)
            messages.append(("/tf", other_ns, tree(link("map", "base_link", moved, other_ns))))
    return messages


@pytest.mark.parametrize(("odom_every", "map_every"), [(1, 1), (1, 3), (2, 1)])
def test_poses_in_two_frames_are_not_mixed(tmp_path, odom_every, map_every):
    path = bag(tmp_path / "a", MOUNTED + two_parents(odom_every, map_every) + clouds(count=5))
    with pytest.warns(UserWarning, match=r"from /tf \(base_link in odom\), not from /tf \(base_link in map\)"):
        recording = RosBag(path)
    for index in range(5):
        np.testing.assert_allclose(recording.get_world_T_vehicle(index), pose_at(0.1 * index), atol=1e-6)


def test_second_path_to_the_same_frame_warns(tmp_path):
    """As in hector_slam issue 27: `map -> odom -> base_link` and `map -> scanmatcher -> base_link`."""
    messages = []
    for k in range(12):
        time_ns = T0_NS + k * STEP_NS // 2
        first = link("map", "odometry", pose_at(0.05 * k), time_ns), link("odometry", "base_link", np.eye(4), time_ns)
        other = build_transform(np.eye(3), [0.3, 0.0, 0.0]) @ pose_at(0.05 * k)
        second = link("map", "matcher", other, time_ns), link("matcher", "base_link", np.eye(4), time_ns)
        messages.append(("/tf", time_ns, tree(*first, *second)))
    with pytest.warns(
        UserWarning, match="map -> (odometry|matcher): not used, since poses are read along another path"
    ):
        recording = RosBag(bag(tmp_path / "a", MOUNTED + messages + clouds(count=5)))
    off_m = np.diff(
        [recording.get_world_T_vehicle(index)[:3, 3] - pose_at(0.1 * index)[:3, 3] for index in range(5)], axis=0
    )
    np.testing.assert_allclose(off_m, 0.0, atol=1e-6)


def test_two_senders_of_one_pose_warn(tmp_path):
    messages = [
        (
            "/tf",
            time_ns,
            tree(link("odom", "base_link", build_transform(np.eye(3), [0.0, 0.3 * (k % 2), 0.0]) @ pose, time_ns)),
        )
        for k, (time_ns, pose) in enumerate((T0_NS + k * 20_000_000, pose_at(0.02 * k)) for k in range(20))
    ]
    with pytest.warns(UserWarning, match=r"\(base_link in odom\) jump to and fro by 0.3 m: do two nodes send them"):
        RosBag(bag(tmp_path / "a", MOUNTED + messages + clouds(count=3)))


def test_conflicting_static_transforms_warn(tmp_path):
    other_mount = build_transform(np.eye(3), [1.0, 0.2, 2.1])
    rack = [static(link("base_link", "rack", raised)), static(link("rack", "lidar", other_mount))]
    driver = [static(link("sensor", "lidar", other_mount))]
    for name, more, told in (
        ("twice", [static(link("base_link", "lidar", other_mount))], "base_link -> lidar is sent with two values"),
        ("rack", rack, r"rack -> lidar is not used: .* off base_link -> lidar"),
        ("driver", driver, ""),
    ):
        path = bag(tmp_path / name, MOUNTED + more + clouds())
        if told:
            with pytest.warns(UserWarning, match=told):
                recording = RosBag(path)
        else:
            recording = RosBag(path)  # a second tree, which says nothing of the vehicle
        expected = other_mount if name == "twice" else mount
        np.testing.assert_allclose(recording.read_scan("lidar", 0).vehicle_T_sensor, expected, atol=1e-12)


def test_frame_of_poses_may_be_above_ground(tmp_path):
    mounted = [static(link("base_link", "lidar", mount), link("base_footprint", "base_link", raised))]
    moved = [moved_tree(k) for k in range(8)]
    with pytest.warns(UserWarning, match="base_footprint is used"):
        recording = RosBag(bag(tmp_path / "a", mounted + moved + clouds(count=3)))
    np.testing.assert_allclose(recording.get_world_T_vehicle(2), pose_at(0.2) @ invert(raised), atol=1e-6)


def test_moving_static_transform_warns(tmp_path):
    both = [static(link("odom", "base_link", mount), link("base_link", "lidar", mount))]
    with pytest.warns(UserWarning, match="odom -> base_link: sent as static and as moving transforms"):
        recording = RosBag(bag(tmp_path / "a", both + [moved_tree(k) for k in range(8)] + clouds(count=3)))
    np.testing.assert_allclose(recording.get_world_T_vehicle(2), pose_at(0.2), atol=1e-6)


@pytest.mark.parametrize("count", [5, 90])
@pytest.mark.parametrize("slowness", [4.0, 20.0])
def test_frame_times_are_stamps(tmp_path, count, slowness):
    """A bag that was recorded during the slow replay of another one."""
    messages = [*MOUNTED, *driven(count * 10), *clouds(count=count)]
    slow = [(topic, T0_NS + int((time_ns - T0_NS) * slowness), message) for topic, time_ns, message in messages]
    with pytest.warns(UserWarning, match="scans of lidar were recorded 0 to .* s after their stamps, which are used"):
        recording = RosBag(bag(tmp_path / "a", sorted(slow, key=lambda one: one[1])))
    np.testing.assert_allclose(recording.times_s, 0.1 * np.arange(count), atol=1e-9)
    np.testing.assert_allclose(recording.get_world_T_vehicle(4), pose_at(0.4), atol=1e-6)


def test_scans_are_paired_by_their_stamps(tmp_path):
    second = [("/b", time_ns + 80_000_000, message) for _, time_ns, message in clouds(count=9)]  # recorded late
    recording = RosBag(bag(tmp_path / "a", [*MOUNTED, *driven(), *clouds(count=5), *second]))
    for sensor in ("b", "lidar"):
        assert recording.read_scan(sensor, 3).offsets_s is None
    assert recording._stamps_ns["b"].tolist() == recording._stamps_ns["lidar"].tolist()


def test_clouds_without_stamps_use_log_times(tmp_path):
    unstamped = [(topic, time_ns, cloud(points(CORNERS_M), 0, "lidar")) for topic, time_ns, _ in clouds(count=3)]
    with pytest.warns(UserWarning, match="clouds of lidar have no stamps: their log times are used"):
        assert RosBag(bag(tmp_path / "a", MOUNTED + unstamped)).times_s.tolist() == pytest.approx([0.0, 0.1, 0.2])


def test_a_gap_in_the_poses_is_not_bridged(tmp_path):
    hole = [
        *driven(2),
        *[("/odom", T0_NS + 15 * STEP_NS + k, odometry(mount, T0_NS + 15 * STEP_NS + k)) for k in range(2)],
    ]
    recording = RosBag(bag(tmp_path / "a", MOUNTED + hole + clouds(count=15)))
    recording.read_scan("lidar", 1)
    with pytest.raises(BadFileError, match=r"the poses before and after .* are 1.49 s apart; .* record more often"):
        recording.read_scan("lidar", 6)


def test_pausing_sensor_is_missing_in_those_frames(tmp_path):
    paused = [
        ("/b", time_ns, message)
        for _, time_ns, message in clouds(count=12)
        if not 3 <= (time_ns - T0_NS) // STEP_NS <= 4
    ]
    recording = RosBag(bag(tmp_path / "a", MOUNTED + clouds(count=9) + paused))
    recording.read_scan("b", 2)
    with pytest.raises(BadFileError, match=r"the scan of b nearest to .* is 0.100 s off"):
        recording.read_scan("b", 3)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("relative_file_paths:", "relative_file_path:"), "relative_file_paths is needed"),
        (("- a.mcap", "- ../a.mcap"), "in its folder are needed; got '../a.mcap'"),
        (("- a.mcap", "- a.mcap.zstd"), "names of .mcap files in its folder are needed"),
        (("compression_mode: ''", "compression_mode: file"), "use `ros2 bag convert`"),
        (("storage_identifier: mcap", "storage_identifier: rosbag_v2"), "got 'rosbag_v2'"),
    ],
)
def test_invalid_metadata_is_refused(tmp_path, change, told):
    path = bag(tmp_path / "a", MOUNTED + clouds())
    text = (path / "metadata.yaml").read_text()
    assert change[0] in text
    (path / "metadata.yaml").write_text(text.replace(*change))
    with pytest.raises(BadFileError, match=told):
        RosBag(path)


REMEDIES = {"mcap": "mcap recover a.mcap -o ", "sqlite3": "sqlite3 a.db3 .recover", "ros1": "rosbag reindex a.bag"}


@pytest.mark.parametrize("share", [0.5, 0.98])
@pytest.mark.parametrize("storage", REMEDIES)
def test_truncated_or_missing_bags_are_bad_files(tmp_path, storage, share):
    if storage == "ros1":
        path = file = bags.bag1(tmp_path / "a.bag", MOUNTED + clouds())
    else:
        path = bag(tmp_path / "a", MOUNTED + clouds(), storage)
        (file,) = path.glob("a.*")
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    for opened in {path, file}:
        with pytest.raises(BadFileError, match=f"damaged or cut off, `{REMEDIES[storage]}"):
            open_recording(opened)
    file.unlink()
    if storage == "ros1":
        return
    with pytest.raises(FileNotFoundError, match=f"{file.name}: no such file; .*metadata.yaml names it"):
        RosBag(path)


GROWN_BYTES = 1_300_000_000


def compress_zeros(compressor):
    """Compress far more zeros than a file may grow to, piece by piece."""
    piece = bytes(10_000_000)
    pieces = [compressor.begin()] if hasattr(compressor, "begin") else []
    pieces += [compressor.compress(piece) for _ in range(GROWN_BYTES // len(piece))]
    return b"".join([*pieces, compressor.flush()])


@pytest.mark.parametrize(
    ("storage", "compression"),
    [("ros1", "BZ2"), ("ros1", "LZ4"), ("mcap", "MESSAGE"), ("mcap", "STORAGE"), ("sqlite3", "MESSAGE")],
)
def test_bags_stay_compressed_and_bounded(tmp_path, monkeypatch, storage, compression):
    def write(name):
        if storage == "ros1":
            return bags.bag1(tmp_path / f"{name}.bag", MOUNTED + clouds(), compression)
        return bag(tmp_path / name, MOUNTED + clouds(), storage, compression)

    assert len(RosBag(write("good")).read_scan("lidar", 1).points_m) == 4
    if compression == "BZ2":  # which takes long to grow
        return
    bomb = compress_zeros(lz4.frame.LZ4FrameCompressor() if storage == "ros1" else zstd.ZstdCompressor())
    assert len(bomb) < GROWN_BYTES / 200
    monkeypatch.setattr(rosbag1.writer, "lz4_compress", lambda *_: bomb)
    monkeypatch.setattr(zstd, "compress", lambda _: bomb)
    path = write("bomb")
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.1")
    told = "Failed to resize buffer" if storage == "ros1" else r"not enough memory .* TORCHCOVER_MAX_FILE_GB above 0.1"
    with pytest.raises(BadFileError, match=rf"bomb.*: .*{told}"):
        RosBag(path)


def test_memory_limit_counts_deserialized_messages(tmp_path, monkeypatch):
    recording = RosBag(bag(tmp_path / "a", MOUNTED + clouds(lambda t: cloud(points(np.zeros((9000, 3))), t, "lidar"))))
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.002")
    with pytest.raises(BadFileError, match=r"reading it takes 0.00216 GB of memory, more than the 0.002 GB"):
        recording.read_scan("lidar", 0)


@pytest.mark.parametrize("storage", ["ros1", "mcap", "sqlite3"])
def test_pipes_and_links_out_of_folder_are_refused(tmp_path, storage):
    if storage == "ros1":
        (tmp_path / "a").mkdir()
        bags.bag1(tmp_path / "a" / "a.bag", MOUNTED + clouds())
    else:
        bag(tmp_path / "a", MOUNTED + clouds(), storage)
    (file,) = (tmp_path / "a").glob("a.*")
    file.rename(tmp_path / file.name)
    file.symlink_to(tmp_path / file.name)
    with pytest.raises(BadFileError, match=rf"{file.name}: a link to .*, outside of the recording"):
        open_recording(tmp_path / "a")
    assert open_recording(tmp_path / "a", link_roots=[tmp_path]).sensors == ("lidar",)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(BadFileError, match="a pipe, a socket or a device; a bag has to be a regular file"):
        RosBag(tmp_path / "a")


@pytest.mark.parametrize("name", ["..%2Fa.db3", "a#.db3", "a?vfs=unix-dotfile&.db3"])
def test_database_names_are_no_uris(tmp_path, name):
    """SQLite would open another file, or create one beside it."""
    path = bag(tmp_path / "a", MOUNTED + clouds(), "sqlite3")
    (path / "a.db3").rename(tmp_path / "a.db3")
    (path / name).write_bytes(b"none")
    (path / "metadata.yaml").write_text((path / "metadata.yaml").read_text().replace("- a.db3", f"- '{name}'"))
    with pytest.raises(BadFileError, match="for parts of an address; rename the file"):
        RosBag(path)


def test_wrong_index_is_detected(tmp_path):
    path = next(bags.ros(Drive(steps=2), tmp_path).glob("*.mcap"))
    data = path.read_bytes()
    count = data.rindex((2).to_bytes(8, "little"))
    path.write_bytes(data[:count] + (3).to_bytes(8, "little") + data[count + 8 :])
    with pytest.raises(BadFileError, match="the index of its messages is missing or incomplete"):
        RosBag(path)


def test_long_chains_of_transforms_are_refused():
    step = build_transform(np.eye(3), [1.0, 0.0, 0.0])
    chain = [link(f"f{k}", f"f{k + 1}", step) for k in range(5001)]
    assert FrameTree(chain[:5000]).find_transforms("f0")["f5000"][0, 3] == 5000.0
    with pytest.raises(ValueError, match="5,001 transforms between different frames; at most 5,000 are read"):
        FrameTree(chain)
