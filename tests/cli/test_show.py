"""Command `show`: figures of rigs, scenarios and vehicles."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread
from PIL import Image

from torchcover.cli import show
from torchcover.evaluation import build_sensor_views, scene_figures
from torchcover.evaluation.rig_names import load_named_rig, make_rig_names
from torchcover.simulation import Rig, Scenario, list_builtin_names


@pytest.fixture
def plotted(monkeypatch):
    """Arguments of the last plotting call."""
    calls: dict = {}
    for name in ("plot_rig", "plot_vehicle", "plot_scene", "plot_depth_images"):
        draw = getattr(scene_figures, name)
        monkeypatch.setattr(
            scene_figures,
            name,
            lambda *args, draw=draw, **kwargs: calls.update(kwargs, args=args) or draw(*args, **kwargs),
        )
    return calls


def test_rig_is_plotted_on_the_ego_vehicle(torchcover, scenes, plotted):
    code, printed, _ = torchcover(
        "show", scenes / "both.yaml", "--scenario", scenes / "yard.yaml", "--out", scenes / "new" / "out"
    )
    assert code == 0
    assert "both.png" in printed
    assert min(imread(scenes / "new" / "out" / "both.png").shape[:2]) > 500
    vertices_m, _, sensors = plotted["args"]
    assert np.ptp(vertices_m, axis=0).tolist() == [4.0, 2.0, 1.0]
    assert [sensor.name for sensor in sensors] == ["front", "rear"]
    assert sensors[1].vertical_fov_deg == pytest.approx((-30.0, 0.0))
    assert (sensors[1].horizontal_fov_deg, sensors[1].range_m) == (90.0, 60.0)
    assert sensors[1].mask_directions(np.array([[-1.0, 0.0, -0.1], [1.0, 0.0, -0.1]])).tolist() == [True, False]


def test_scenario_is_plotted_in_the_vehicle_frame(torchcover, scenes, plotted):
    code, _, _ = torchcover(
        "show", scenes / "yard.yaml", "--rig", scenes / "low.yaml", "--frame-index", 3, "--out", scenes
    )
    assert code == 0
    assert min(imread(scenes / "yard.png").shape[:2]) > 500
    ahead, far = plotted["actors"]
    assert (ahead.category, far.category) == ("box", "far")
    np.testing.assert_allclose(sorted(ahead.outline_m[:, 0].round(6)), [18.0, 18.0, 22.0, 22.0])
    np.testing.assert_allclose(sorted(ahead.outline_m[:, 1].round(6)), [4.0, 4.0, 6.0, 6.0])
    assert plotted["title"] == "yard, frame 3"
    # Sensor points lie on the plotted actor.
    sensor = plotted["sensor_points"]
    on_actor = sensor[sensor[:, 2] > 0.1]
    assert len(on_actor)
    assert (np.abs(on_actor[:, 0] - 20.0) < 2.1).all()
    assert (np.abs(on_actor[:, 1] - 5.0) < 1.1).all()
    assert len(plotted["reference_points"]) > 1000


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    ("size", "message", "warning"),
    [
        ("4.5 1.8 1.5", "4.50 m long (x, forward), 1.80 m wide (y), 1.50 m high (z, up)", ""),
        ("1.8 4.5 1.5", "1.80 m long", "wider than long; a vehicle's x axis points forward"),
        ("83.7 30 25", "83.70 m long", "far too large for a vehicle on a road; a file in millimeters"),
    ],
)
def test_mesh_prints_size_and_warnings(torchcover, tmp_path, size, message, warning):
    trimesh.creation.box([float(number) for number in size.split()]).export(tmp_path / "car.obj")
    (tmp_path / "car.yaml").write_text("name: car\nparts: [{name: body, shape: {type: mesh, path: car.obj}}]\n")
    for name in ("car.obj", "car.yaml"):
        code, printed, stderr = torchcover("show", tmp_path / name, "--out", tmp_path)
        assert code == 0
        assert message in printed
        half_m = float(size.split()[2]) / 2  # trimesh centers a box at the origin
        moved = f"Moved by x +0.00, y +0.00, z {half_m:+.2f} m: mounting positions are relative to the ground"
        assert moved in " ".join(printed.split())
        assert (tmp_path / "car.png").is_file()
        assert warning in stderr
        assert bool(stderr) == bool(warning)
    assert "Moved" not in torchcover("show", "suv", "--out", tmp_path)[1]
    code, _, error = torchcover("show", tmp_path / "none.obj")
    assert code == 2
    assert "none.obj" in error


def test_urdf_becomes_vehicle_and_rig(torchcover, tmp_path):
    box = "<visual><geometry><box size='0.8 0.6 0.4'/></geometry></visual>"
    camera = (
        "<camera><horizontal_fov>1.5</horizontal_fov><image><width>64</width><height>48</height></image>"
        "<clip><near>0.1</near><far>9</far></clip></camera>"
    )
    sensor = f"<sensor name='d' type='depth'><pose>0.5 0 0 0 0 0</pose>{camera}</sensor>"
    urdf = tmp_path / "bot.urdf"
    urdf.write_text(f"<robot name='bot'><link name='b'>{box}</link><gazebo reference='b'>{sensor}</gazebo></robot>")
    code, printed, _ = torchcover("robot", urdf, "--out", tmp_path / "bot")
    assert code == 0
    assert "rig.yaml with 1 sensors; plot it: torchcover show" in " ".join(printed.split())
    shown = torchcover("show", tmp_path / "bot" / "rig.yaml", "--out", tmp_path)
    assert shown[0] == 0
    assert "No ray hits the ego vehicle." in shown[1]
    urdf.write_text(f"<robot name='bot'><link name='b'>{box}</link></robot>")
    code, printed, _ = torchcover("robot", urdf, "--out", tmp_path / "none")
    assert code == 0
    assert "no rig: no Gazebo tag has a sensor" in printed
    code, _, error = torchcover("robot", urdf, "--package", "bot")
    assert (code, error.count("\n"), "--package bot: NAME=VALUE is needed" in error) == (2, 1, True)


@pytest.mark.parametrize(("text", "message"), [
    ("<robot name='a'><link", "not readable as a URDF"),
    ("<robot name='a'/>", "a <robot> with links is needed"),
    ("<robot name='a'><link name='b'/></robot>", "no link has a visual or collision geometry"),
    ("<robot name='a'><link name='b'><visual><geometry><mesh filename='no.stl'/></geometry></visual></link></robot>",
     "1 of 1 meshes are missing: no.stl"),
    ("<robot name='a'><link name='b'><visual><geometry><box size='1 nan 1'/></geometry></visual></link></robot>",
     "box size: 3 numbers needed"),
    ("<robot name='a'><link name='b'><visual><geometry><box size='1 -2 1'/></geometry></visual></link></robot>",
     "link 'b': <box>: size_m.1: a number above 0 is needed; got -2.0\n"),
    ("<robot name='a'><link name='b'><visual><geometry><sphere radius='0'/></geometry></visual></link></robot>",
     "link 'b': <sphere>: size_m.0: a number above 0 is needed; got 0.0"),
    ("<robot name='a'><link name='b'/><joint name='j'><parent link='b'/><child link='c'/></joint></robot>",
     "joint 'j' refers to 'c', which is no link"),
])  # fmt: skip
def test_invalid_urdf_is_one_line(torchcover, tmp_path, text, message):
    path = tmp_path / "bad.urdf"
    path.write_text(text)
    code, printed, error = torchcover("robot", path, "--out", tmp_path / "bot")
    assert (code, printed, error.count("\n")) == (2, "", 1)
    assert error.startswith(f"torchcover: {path}: ")
    assert message in error
    assert not (tmp_path / "bot").exists()


def test_roadside_rig_is_plotted(torchcover, tmp_path):
    rig = tmp_path / "mast.yaml"
    rig.write_text(
        "name: mast\nsensors: [{name: top, mount: {z_m: 6.0}, channels: 8, vertical_fov_deg: [-60, 0], columns: 64, "
        "horizontal_fov_deg: 360, max_range_m: 50}]\n"
    )
    assert torchcover("show", "courtyard", "--rig", rig, "--out", tmp_path)[0] == 0


def test_mount_regions_lie_on_the_vehicle_surface(torchcover, tmp_path, plotted):
    (tmp_path / "cart.yaml").write_text(
        """
        name: cart
        description: A box on wheels that are left out.
        parts: [{name: body, shape: {type: box, size_m: [3.0, 1.0, 0.8]}}]
        mount_regions:
          lid: {side: above, x_m: [-1.0, 1.0], y_m: [-0.4, 0.4]}
          tail: {side: rear, y_m: [-0.3, 0.3], z_m: [0.2, 0.6]}
        """
    )
    code, printed, _ = torchcover("show", tmp_path / "cart.yaml", "--out", tmp_path)
    assert code == 0
    assert "A box on wheels" in printed
    assert min(imread(tmp_path / "cart.png").shape[:2]) > 500
    _, _, (lid, tail) = plotted["args"]
    assert (lid.name, lid.side, tail.name, tail.side) == ("lid", "above", "tail", "rear")
    for patch, lowest, highest in (
        (lid, [-1.0, -0.4, 0.8], [1.0, 0.4, 0.8]),
        (tail, [-1.5, -0.3, 0.2], [-1.5, 0.3, 0.6]),
    ):
        assert patch.points_m.min(axis=(0, 1)) == pytest.approx(lowest)
        assert patch.points_m.max(axis=(0, 1)) == pytest.approx(highest)


def test_mount_region_outside_the_body_is_named(torchcover, tmp_path):
    (tmp_path / "cart.yaml").write_text(
        "name: cart\nparts: [{name: body, shape: {type: box, size_m: [3.0, 1.0, 0.8]}}]\n"
        "mount_regions: {lid: {side: above, x_m: [1.0, 2.0], y_m: [-0.4, 0.4]}}\n"
    )
    code, _, error = torchcover("show", tmp_path / "cart.yaml", "--out", tmp_path)
    assert code == 2
    assert "mount region 'lid': at x = 1.545 m" in error


def test_depth_images_belong_to_the_chosen_frame(torchcover, scenes, plotted):
    """A wall fills the left half of the image: 20 m ahead of the bumper in the first frame, 15 m in the chosen one."""
    (scenes / "cameras.yaml").write_text(
        "name: cameras\nsensors:\n"
        "  - {type: camera, name: a, mount: {x_m: 2, z_m: 1}, width: 40, height: 20, fov_deg: 90, max_range_m: 60}\n"
        "  - {type: camera, name: b, mount: {x_m: 2, z_m: 1}, width: 40, height: 40, stride: 2, fx: 20, fy: 20,"
        " cx: 19.5, cy: 19.5, lens: brown_conrady, coefficients: [-0.5, 0, 0, 0], max_range_m: 60}\n"
    )
    (scenes / "wall.yaml").write_text(
        "name: wall\n"
        "ego: {shape: {type: box, size_m: [3.8, 2, 0.5]}, trajectory: drive.csv}\n"
        "bodies:\n"
        "  - {name: ground, shape: {type: plane, size_m: [400, 400]}}\n"
        "  - {name: wall, shape: {type: box, size_m: [1, 50, 3]}, poses: [{x_m: 22.5, y_m: 25}]}\n"
        "duration_s: 1\ntime_step_s: 0.5\n"
    )
    (scenes / "drive.csv").write_text("t,x,y,z,roll,pitch,yaw\n0,0,0,0,0,0,0\n0.5,2.5,0,0,0,0,0\n1,5,0,0,0,0,0\n")
    code, printed, _ = torchcover(
        "show", scenes / "cameras.yaml", "--scenario", scenes / "wall.yaml", "--frame-index", 2, "--out", scenes
    )
    assert code == 0
    assert "cameras_depth.png" in printed
    assert imread(scenes / "cameras_depth.png").shape[1] > 500
    (images,) = plotted["args"]
    assert {name: image.shape for name, image in images.items()} == {"a": (20, 40), "b": (20, 20)}
    # One row above the middle the rays rise by half a pixel of 20 a metre.
    across = (19.5 - np.arange(20)) / 20
    np.testing.assert_allclose(images["a"][9, :20], 15 * np.sqrt(1 + across**2 + (0.5 / 20) ** 2), rtol=1e-5)
    assert np.isinf(images["a"][9, 20:]).all()
    assert np.isnan(images["b"]).any()
    assert "t = 1 s" in plotted["subtitle"]


@pytest.mark.parametrize("arguments", [["three_cameras", "--scenario"], []])
def test_scene_is_built_once(torchcover, scenes, monkeypatch, arguments):
    built = []
    build = Scenario.build_scene
    monkeypatch.setattr(Scenario, "build_scene", lambda *args: built.append(args) or build(*args))
    assert torchcover("show", *arguments, scenes / "yard.yaml", "--out", scenes)[0] == 0
    assert len(built) == 1


@pytest.mark.parametrize("name", list_builtin_names("rigs"))
def test_built_in_rigs_have_valid_fields_of_view(name):
    for sensor in build_sensor_views(Rig.load(name).sensors):
        low, high = sensor.vertical_fov_deg
        assert -90 <= low < high <= 90
        assert 0 < sensor.horizontal_fov_deg <= 360
        forward = sensor.vehicle_T_sensor[:3, :3] @ [1.0, 0.0, np.tan(np.deg2rad((low + high) / 2))]
        assert sensor.mask_directions(forward[None]).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["moon"], "'moon' is neither a .yaml file nor built in; is "),
        (["none.yaml"], "none.yaml: no such file"),
        (["kitti", "--rig", "nuscenes"], "--rig: for a scenario only, and 'kitti' is a rig"),
        (
            ["kitti", "--frame-index", "1", "--seed", "2"],
            "--frame-index, --seed: for a scenario or cameras only, and 'kitti' is a rig",
        ),
        (["courtyard", "--scenario", "urban"], "--scenario: for a rig only, and 'courtyard' is a scenario"),
        (["suv", "--frame-index", "1"], "--frame-index: for rigs and scenarios only, and 'suv' is a vehicle"),
        (["suv", "--animation", "x.gif"], "--animation: for a scenario only, and 'suv' is a vehicle"),
        (["courtyard", "--rig", "moon"], "built-in rigs; is "),
        (["kitti", "--scenario", "moon"], "built-in scenarios; is "),
        (["courtyard", "--frame-index", "-1"], "--frame-index"),
        ([], "Missing argument"),
    ],
)
def test_user_error_is_one_line_with_code_2(torchcover, arguments, message, tmp_path):
    code, _, error = torchcover("show", *arguments, "--out", tmp_path / "out")
    assert code == 2
    assert message in error
    assert error.startswith("torchcover: ")
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [("{", "not a YAML file"), ("sensors: 3", "sensors: "), ("name: x", "bodies missing"), ("- 1", "a YAML mapping")],
)
def test_invalid_document_names_the_mistake(torchcover, tmp_path, content, message):
    (tmp_path / "bad.yaml").write_text(content)
    code, _, error = torchcover("show", tmp_path / "bad.yaml")
    assert code == 2
    assert message in error
    assert error.count("\n") == 1


def test_ambiguous_name_asks_for_the_file(torchcover, monkeypatch):
    monkeypatch.setattr(show, "list_builtin_names", lambda kind: ["twin", kind])
    code, _, error = torchcover("show", "twin")
    assert code == 2
    assert "both a rig and a scenario and a vehicle: give the YAML file" in error


@pytest.mark.filterwarnings("default")
def test_warning_is_printed_once_as_one_line(torchcover, scenes):
    """Two actors share an open mesh in millimeters."""
    mesh = Scenario.load(scenes / "yard.yaml").ego.shape.build_mesh()
    corners = "".join(f"v {x * 1000} {y * 1000} {z * 1000}\n" for x, y, z in mesh.vertices_m)
    (scenes / "car.obj").write_text(corners + "".join(f"f {a} {b} {c}\n" for a, b, c in mesh.faces[1:] + 1))
    shape = "shape: {type: mesh, path: car.obj}"
    (scenes / "yard.yaml").write_text(
        "name: yard\n"
        "ego: {shape: {type: box, size_m: [4, 2, 1]}}\n"
        "bodies: [{name: ground, shape: {type: plane, size_m: [400, 400]}}]\n"
        f"actors: [{{name: a, category: car, {shape}, pose: {{x_m: 9000}}}}, {{name: b, category: car, {shape},"
        " pose: {x_m: -9000}}]\n"
    )
    code, _, error = torchcover("show", scenes / "yard.yaml", "--rig", scenes / "low.yaml", "--out", scenes)
    assert code == 0
    lines = error.splitlines()
    assert all(line.startswith("torchcover: warning: ") for line in lines)
    for actor in ("a", "b"):
        assert [f"{actor}: 3 of 18 of its edges have a face on one side only" in line for line in lines].count(
            True
        ) == 1
    assert ["a: its body is 4,000 x 2,000 x 1,000 m" in line for line in lines].count(True) == 1
    assert len(lines) == 4


def test_rig_keeps_its_name_in_a_renamed_file(scenes):
    (scenes / "renamed.yaml").write_text((scenes / "both.yaml").read_text())
    name = Rig.load(scenes / "both.yaml").name
    assert [load_named_rig(scenes / "renamed.yaml").name] == make_rig_names([scenes / "renamed.yaml"]) == [name]


def test_description_of_a_rig_is_printed(torchcover, tmp_path):
    code, printed, _ = torchcover("show", "nuscenes", "--out", tmp_path)
    assert (code, " ".join(printed.split())[:60]) == (0, Rig.load("nuscenes").description[:60])


def test_animation_shows_the_following_frames(torchcover, scenes, monkeypatch):
    select_frames = partial(show.select_animation_frames, duration_s=0.3)
    monkeypatch.setattr(show, "select_animation_frames", select_frames)
    code, printed, _ = torchcover(
        "show",
        scenes / "yard.yaml",
        "--rig",
        scenes / "low.yaml",
        "--animation",
        scenes / "new" / "a.gif",
        "--frame-index",
        1,
    )
    assert (code, "a.gif" in printed) == (0, True)
    with Image.open(scenes / "new" / "a.gif") as animation:
        images = []
        for number in range(animation.n_frames):
            animation.seek(number)
            images.append(np.asarray(animation.convert("RGB")))
        pace_s = animation.info["duration"] / 1000
    time_step_s = Scenario.load(scenes / "yard.yaml").effective_time_step_s
    frame_indices = select_frames(time_step_s, 1)
    assert len(images) == len(frame_indices) >= 2
    assert pace_s == pytest.approx(frame_indices.step * time_step_s)
    assert all((first != second).any() for first, second in pairwise(images))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("yard.yaml", "--animation", "a.avi"), "an animation is a .gif or .mp4 file; got 'a.avi'"),
        (("low.yaml", "--animation", "a.gif"), "--animation: for a scenario only"),
        (("yard.yaml", "--animation", "a.mp4"), ".mp4 needs the program ffmpeg, which is missing; write a .gif"),
    ],
)
def test_invalid_animation_file_is_rejected(options, message, torchcover, scenes, monkeypatch):
    monkeypatch.setenv("PATH", "")
    name, *arguments = options
    code, _, stderr = torchcover("show", scenes / name, *arguments)
    assert code == 2
    assert message in stderr


@pytest.mark.parametrize("at_m", [50.0, 160.8])
def test_height_above_ground_follows_a_slope(at_m, torchcover, scenes, plotted):
    slope = np.deg2rad(4.0)
    # The second part of the slope begins at the edge of the picture, below bodies that reach into the picture.
    grounds, kerb = (
        ", ".join(f"{{x_m: {x * np.cos(slope)}, z_m: {x * np.sin(slope)}, pitch_deg: -4}}" for x in along_m)
        for along_m in ([-39.5, 360.5], [at_m])
    )
    (scenes / "slope.yaml").write_text(
        "name: slope\nego: {shape: {type: box, size_m: [4, 2, 1]}, pose: {z_m: 0.2}}\nbodies:\n"
        f"  - {{name: ground, shape: {{type: plane, size_m: [400, 400]}}, poses: [{grounds}]}}\n"
        f"  - {{name: kerb, shape: {{type: box, size_m: [9, 5, 1]}}, poses: [{kerb}]}}\n"
    )
    code, _, _ = torchcover("show", scenes / "slope.yaml", "--rig", scenes / "low.yaml", "--out", scenes)
    assert code == 0
    static_faces = plotted["static_faces"]
    assert np.abs(static_faces.triangles_m[..., 0] - at_m).max() < 5.0  # the slope is ground, not scenery
    # The last two faces of a box are its top; the two faces before are its bottom, which lies on the slope.
    np.testing.assert_allclose(static_faces.height_m[-4:], [0, 0, 1.0024, 1.0024], atol=1e-3)
    assert static_faces.height_m.max() < 1.5  # 4.5 m above the ego vehicle
