"""Runs of SUMO: sampled streets and traffic, OpenDRIVE, and rejected inputs."""

import hashlib
import os
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader

from torchcover import Rig, Scenario
from torchcover.data import SimulatedFrames
from torchcover.files import BadFileError, parse_xml
from torchcover.simulation import PaperReference
from torchcover.simulation.sumo import SumoTraffic, simulating, traffic
from torchcover.simulation.sumo.network import read_network
from torchcover.simulation.sumo.routes import write_routes
from torchcover.simulation.sumo.simulating import convert_opendrive
from torchcover.simulation.sumo.streets import TOWN, RandomStreets, compute_turning_speed_mps
from torchcover.simulation.traffic.fleet import BODY_KINDS, Fleet, load_bodies

from .towns import XODR, street, write_net

ROOT = Path(__file__).parents[3]
LITTLE = {"traffic_per_km": 2.0, "people_per_km": 1.0, "buses_per_km": 0.2, "cyclists_per_km": 0.5}

ROUTES = """<routes><vType id="car" length="5"/>{more}<vehicle id="{name}" type="car" depart="1" departSpeed="10">
<route edges="-1"/></vehicle></routes>"""


def make_traffic(network="grid", **options):
    return SumoTraffic(random={"layout": network, **LITTLE, **options}, duration_s=2.0, time_step_s=0.5)


def hash_scene(world):
    parts = [mesh.vertices_m for mesh in world.static_meshes]
    for actor in (world.ego, *world.objects):
        parts += [actor.trajectory.positions_m, actor.trajectory.angles_deg, actor.trajectory.times_s]
    return hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest()


def test_scenes_are_equal_in_all_processes():
    program = "from tests.simulation.sumo.test_drawn import *; print(hash_scene(make_traffic().build_scene(7)))"
    environment = {**os.environ, "PYTHONHASHSEED": "12345"}
    there = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True, cwd=ROOT
    )
    world = make_traffic().build_scene(7)
    assert there.stdout.strip() == hash_scene(world)
    assert len(world.objects) > 20


def test_workers_agree_and_runs_differ():
    scenario = Scenario(name="town", traffic=make_traffic())
    frames = SimulatedFrames(
        scenario,
        Rig.load("front_grille_128"),
        num_frames=6,
        seed=1,
        reference_sensor=PaperReference(rows=8, columns=16),
    )
    here = [frame.reference for frame in (frames[0], frames[5])]
    workers = DataLoader(frames, batch_size=None, sampler=[0, 5], num_workers=2)
    for one, other in zip(here, workers, strict=True):
        np.testing.assert_array_equal(one, other.reference)
    towns = [frames.simulator.get_scene_geometry(index)[0].scene.static_meshes[1] for index in (0, 5)]
    assert len(towns[0].vertices_m) != len(towns[1].vertices_m)


@pytest.mark.parametrize("network", ["rand", "grid", "spider"])
def test_sampled_streets_have_no_dead_ends(network, tmp_path):
    streets = RandomStreets(layout=network, max_lanes_per_direction=3, hill_height_std_m=0.0)
    town = read_network(streets.build_network(tmp_path, np.random.default_rng(2)))
    assert not any(lane.line_m[:, 2].any() for lane in town.lanes)
    assert {lane.use for lane in town.lanes} == {"road", "turn", "bay", "sidewalk", "crossing", "corner"}
    turns = [lane for lane in town.lanes if lane.use == "turn"]
    assert all(lane.speed_mps <= compute_turning_speed_mps(lane.line_m[:, :2]) + 0.01 for lane in turns)
    follow = town.find_successors("passenger")
    assert len(follow) > 10
    assert all(follow.values())
    # No edge is a dead end.
    assert all({after.strip("-") for after in found} != {edge.strip("-")} for edge, found in follow.items())


def test_sampled_traffic_has_bodies_of_all_sizes(tmp_path):
    generator, streets = np.random.default_rng(0), RandomStreets(layout="grid", buses_per_km=5.0)
    town, routes = read_network(streets.build_network(tmp_path, generator)), tmp_path / "sampled.rou.xml"
    fleet = Fleet(load_bodies(), None, generator)
    write_routes(routes, town, streets, fleet, 20.0, generator)
    told = parse_xml(routes)
    lengths_m = {kind.get("id"): float(kind.get("length", "nan")) for kind in told.iter("vType")}
    driven = [vehicle.get("type") for vehicle in told.iter("vehicle")]
    assert {BODY_KINDS[kind] for kind in driven if kind != "ego"} > {"sedan", "suv", "hatchback", "van", "lorry", "bus"}
    assert len({lengths_m[kind] for kind in driven}) > 12
    assert all(abs(lengths_m[kind] - fleet.get_length_m(kind)) < 0.01 for kind in driven)


def test_opendrive_heights_and_sidewalks_are_converted(tmp_path):
    (tmp_path / "road.xodr").write_text(XODR)
    (tmp_path / "r.xml").write_text(ROUTES.format(name="me", more=""))
    made = SumoTraffic(
        net=tmp_path / "road.xodr", routes=(tmp_path / "r.xml",), ego_id="me", begin_s=0.0, duration_s=8.0
    )
    world = made.build_scene(0)
    x_m, _, z_m = world.ego.trajectory.positions_m.T
    assert np.ptp(x_m) > 60.0
    assert np.polyfit(x_m, z_m, 1)[0] == pytest.approx(0.04, abs=0.004)
    assert np.abs(world.ego.trajectory.positions_m[:, 1]).max() < 1.0  # no car goes onto the sidewalk
    np.testing.assert_allclose(world.ego.trajectory.angles_deg[:, 1].mean(), -np.rad2deg(np.arctan(0.04)), atol=0.5)
    assert len(world.static_meshes) == 4  # ground, sidewalk, houses, trees


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        (
            "<lanes>",
            '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile><lanes>',
            "superel",
        ),
        ("<lanes>", '<lateralProfile><crossfall s="0" a="0.02"/></lateralProfile><lanes>', "crossfall of 1 pieces"),
        (
            "</lanes>",
            '</lanes><objects><object id="1" type="building" s="9" t="9"/></objects>',
            r"objects \(1 building\)",
        ),
        (
            '<width sOffset="0" a="2" b="0" c="0" d="0"/>',
            '<border sOffset="0" a="-9" b="0" c="0" d="0"/>',
            "1 lanes whose width is given by <border>",
        ),
    ],
)
def test_unconverted_opendrive_content_is_reported(old, new, told, tmp_path):
    assert XODR.count(old) == 1
    (tmp_path / "road.xodr").write_text(XODR.replace(old, new))
    with pytest.warns(UserWarning, match=f"OpenDRIVE: SUMO's netconvert does not convert .*{told}"):
        convert_opendrive(tmp_path / "road.xodr", tmp_path, omit_missing_links=False)
    (tmp_path / "road.xodr").write_text(XODR.replace('junction="-1"', 'junction="-1" rule="LHT"'))
    with pytest.raises(BadFileError, match=r"road 1: left-hand traffic .* netconvert --lefthand"):
        convert_opendrive(tmp_path / "road.xodr", tmp_path, omit_missing_links=False)


MANY = " ".join(f"a{number}='1'" for number in range(1001))  # SUMO compares each attribute with each


def test_opendrive_projections_and_attribute_counts_are_checked(tmp_path):
    """Check projections, because PROJ would wait for a pipe forever."""
    reference = "<geoReference><![CDATA[{}]]></geoReference></header>"
    (tmp_path / "road.xodr").write_text(XODR.replace("<road", f"<road {MANY}", 1))
    with pytest.raises(BadFileError, match="<road> has 1005 attributes; at most 1000 are read"):
        convert_opendrive(tmp_path / "road.xodr", tmp_path, omit_missing_links=False)
    for words, told in (("+proj=utm +geoidgrids=/a/pipe", "'.*/a/pipe' names a file"), ("+proj=utm +zone=32", None)):
        (tmp_path / "road.xodr").write_text(XODR.replace('"4"/>', f'"4">{reference.format(words)}', 1))
        with nullcontext() if told is None else pytest.raises(BadFileError, match=f"the projection {told}; remove"):
            convert_opendrive(tmp_path / "road.xodr", tmp_path, omit_missing_links=False)


def test_missing_opendrive_links_are_named_or_omitted(tmp_path):
    link = '<link><predecessor elementType="road" elementId="7" contactPoint="end"/></link>'
    nowhere = '<junction id="8" type="direct"><connection id="0" incomingRoad="1" linkedRoad="1"/></junction>'
    (tmp_path / "road.xodr").write_text(
        XODR.replace("<planView>", f"{link}<planView>").replace("</OpenDRIVE>", f"{nowhere}</OpenDRIVE>")
    )
    (tmp_path / "r.xml").write_text(ROUTES.format(name="me", more=""))
    made = SumoTraffic(
        net=tmp_path / "road.xodr", routes=(tmp_path / "r.xml",), ego_id="me", begin_s=0.0, duration_s=2.0
    )
    told = "road 1, predecessor road 7; junction 8, connection 0, connectingRoad .none.; `omit_missing_links: true`"
    with pytest.raises(BadFileError, match=f"road.xodr: SUMO's netconvert fails: .*{told}"):
        made.build_scene(0)
    assert made.model_copy(update={"omit_missing_links": True}).build_scene(0).ego.trajectory.is_moving


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<OpenDRIVE/>", "SUMO's netconvert fails: .+"),
        ("<OpenDRIVE><road/></OpenDRIVE>", "SUMO's netconvert fails: .+"),
        ("<net/>", "begins with <OpenDRIVE>; got <net>"),
        ("<!DOCTYPE a [<!ENTITY e 'x'>]><OpenDRIVE>&e;</OpenDRIVE>", "without entities"),
    ],
)
def test_errors_of_netconvert_are_reported(text, message, tmp_path):
    (tmp_path / "road.xodr").write_text(text)
    with pytest.raises(BadFileError, match=f"road.xodr: .*{message}"):
        SumoTraffic(net=tmp_path / "road.xodr", random={}, duration_s=2.0).build_scene(0)


def test_messages_of_sumo_are_reported_and_entities_rejected(tmp_path):
    net = write_net(tmp_path / "a.net.xml", street())
    routes = tmp_path / "r.xml"
    made = SumoTraffic(net=net, routes=(routes,), duration_s=2.0)
    routes.write_text(ROUTES.format(name="me", more=""))
    with pytest.raises(ValueError, match=r"SUMO's sumo fails: .+") as failed:
        made.build_scene(0)
    assert "\n" not in str(failed.value)
    routes.write_text("<!DOCTYPE a [<!ENTITY e SYSTEM 'file:///etc/passwd'>]><routes>&e;</routes>")
    with pytest.raises(BadFileError, match=r"r\.xml: .*without entities"):
        made.build_scene(0)
    with pytest.raises(FileNotFoundError, match=r"none\.xml"):
        SumoTraffic(net=net, routes=(tmp_path / "none.xml",), duration_s=2.0).build_scene(0)


OUTPUT = "x.out"


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    """Return a network with one street, the edge -1."""
    folder = tmp_path_factory.mktemp("road")
    (folder / "road.xodr").write_text(XODR)
    return simulating.convert_opendrive(folder / "road.xodr", folder, omit_missing_links=False)


@pytest.mark.parametrize(
    ("where", "added", "told"),
    [
        ("route", '<param key="device.ssm.file" value="{out}"/>', "'device.ssm.file' of <vehicle>"),
        ("route", '<param key="device.toc.file" value="localhost:9"/>', "'device.toc.file' of <vehicle>"),
        ("route", '<param key="has.ssm.device" value="true"/>', "'has.ssm.device' of <vehicle>"),
        ("route", '<param key="device.fcd-replay.file" value="/etc/passwd"/>', "'device.fcd-replay.file' of <vehicle>"),
        (
            "route",
            '<param key="device.taxi.dispatch-algorithm.output" value="{out}"/>',
            "algorithm.output' of <vehicle>",
        ),
        ("root", '<include href="{out}"/>', "<include> is not read"),
        ("root", '<calibrator id="c" edge="a" pos="1" output="{out}"/>', "<calibrator> is not read"),
        ("root", f'<vType id="t" {MANY}/>', "<vType> has 1002 attributes"),
        ("root", '<vType id="t" output="{out}"/>', "'output' of <vType> names a file or an address"),
        ("root", '<x:inductionLoop xmlns:x="a" id="e" file="{out}"/>', "<x:inductionLoop> is not read"),
        ("net", '<inductionLoop id="e" lane="a_0" pos="1" freq="1" file="{out}"/>', "<inductionLoop> is not read"),
        ("net", '<edgeData id="e" file="{out}"/>', "<edgeData> is not read"),
        ("net", '<vTypeProbe id="e" file="{out}"/>', "<vTypeProbe> is not read"),
        ("net", '<rerouter id="r" edges="a" file="{out}"/>', "<rerouter> is not read"),
        ("net", '<timedEvent type="SaveTLSStates" source="0" dest="{out}"/>', "<timedEvent> is not read"),
        (
            "net",
            '<tlLogic id="0" type="actuated" programID="p"><param key="file" value="{out}"/></tlLogic>',
            "'file' of",
        ),
        ("net", '<tlLogic id="0" type="swarm" programID="p"/>', "<tlLogic> of type 'swarm' is not read"),
        ("net", '<include href="{out}"/>', "<include> is not read"),
        ("net", '<location projParameter="+proj=utm +nadgrids=/a/pipe"/>', "/a/pipe' names a file; remove"),
        ("net", '<location projParameter="+proj=utm +nadgrids=http://a/x"/>', "http://a/x' names a file; remove"),
    ],
)
def test_outputs_and_addresses_in_files_are_rejected(road, tmp_path, where, added, told):
    out = tmp_path / OUTPUT
    out.write_text("a user's file")
    added = added.format(out=out)
    (tmp_path / "a.net.xml").write_text(road.read_text().replace("</net>", f"{added * (where == 'net')}</net>"))
    route = f'<vehicle id="me" depart="0"><route edges="-1"/>{added * (where == "route")}</vehicle>'
    (tmp_path / "r.xml").write_text(f"<routes>{added * (where == 'root')}{route}</routes>")
    with pytest.raises(BadFileError, match=re.escape(told)):
        SumoTraffic(
            net=tmp_path / "a.net.xml", routes=(tmp_path / "r.xml",), ego_id="me", begin_s=0.0, duration_s=1.0
        ).build_scene(0)
    assert [one.read_text() for one in tmp_path.glob(OUTPUT)] == ["a user's file"]


def test_pictures_and_notes_in_files_are_ignored(road, tmp_path):
    routes = tmp_path / "a,b.xml"  # SUMO would split the name into two files
    notes = '<param key="my note" value="a/b.xml"/><param key="has.rerouting.device" value="true"/>'
    routes.write_text(
        '<routes><vType id="t" imgFile="car.png" emissionClass="PHEMlight/../x" lcStrategic="1" jmTimegapMinor="1"/>'
        f'<vehicle id="me" type="t" depart="0"><route edges="-1"/>{notes}</vehicle></routes>'
    )
    world = SumoTraffic(net=road, routes=(routes,), ego_id="me", begin_s=1.0, duration_s=1.0).build_scene(0)
    assert len(world.ego.trajectory.times_s)


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("head -c 3000000 /dev/zero >&2; echo x > {new} || kill -XFSZ $$", "SUMO's sumo tried to write a file"),
        (
            "echo 'Error: std::bad_alloc while parsing' >&2; : > {new}; exit 1",
            r"bad_alloc while parsing; it may take 3 GB: .* TORCHCOVER_MAX_FILE_GB to",
        ),
    ],
)
def test_failures_of_sumo_programs_are_explained(script, message, tmp_path, monkeypatch):
    program, new = tmp_path / "bin" / "sumo", tmp_path / "new"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\n{script.format(new=new)}")
    program.chmod(0o700)
    monkeypatch.setattr(simulating, "find_sumo_home", lambda: tmp_path)
    with pytest.raises(ValueError, match=message):
        list(simulating.stream_output("sumo"))
    assert new.read_text() == ""


def test_simulations_that_end_too_early_are_rejected(tmp_path):
    net, routes = RandomStreets().build_network(tmp_path, np.random.default_rng(0)), tmp_path / "r.xml"
    routes.write_text("<routes/>")
    with pytest.raises(ValueError, match=r"the simulation ends before t = 60 s, where the run begins: .*begin_s"):
        SumoTraffic(net=net, routes=(routes,), duration_s=2.0).build_scene(0)


def test_missing_sumo_is_reported_in_one_line(monkeypatch):
    monkeypatch.setattr(simulating, "find_spec", lambda _: None)
    monkeypatch.setattr(simulating, "which", lambda _: None)
    with pytest.raises(ImportError, match=r"^traffic of type 'sumo' needs SUMO: pip install 'torchcover\[sumo\]'$"):
        make_traffic().build_scene(0)


def test_networks_without_routes_and_excess_traffic_are_rejected(tmp_path):
    net = write_net(tmp_path / "a.net.xml", street())
    with pytest.raises(ValueError, match="no street that cars may use and that leads on"):
        SumoTraffic(net=net, random={}, duration_s=2.0).build_scene(0)
    with pytest.raises(ValueError, match=r"traffic of about [\d,]+ vehicles and people; at most 20,000 are sampled"):
        make_traffic(
            traffic_per_km=200.0, people_per_km=1000.0, cyclists_per_km=1000.0, buses_per_km=200.0
        ).build_scene(0)


def test_density_limits_and_omissions_are_reported(monkeypatch):
    for key in LITTLE:
        with pytest.raises(ValueError, match=rf"random\.{key}: a number of at most"):
            make_traffic(**{key: 1400.0})
    monkeypatch.setattr(traffic, "drop_colliding_users", lambda bodies: bodies[:1])
    bare = {"built_share": 0.0, "parked_share": 0.0, "roadside_density": 0.0}
    with pytest.warns(UserWarning, match=r"^\d of \d road users of the simulation are left out"):
        world = make_traffic(**dict.fromkeys(LITTLE, 0.0)).model_copy(update=bare).build_scene(0)
    assert not world.objects
    assert world.num_omitted_road_users > 0  # the other candidates for the ego vehicle


def test_turning_speed_follows_the_tightest_part():
    angle = np.linspace(0.0, np.pi / 2, 40)
    arc_m = 6.0 * np.stack([np.sin(angle), 1 - np.cos(angle)], axis=1)
    lead_m = np.column_stack([np.linspace(-30.0, -1.0, 30), np.zeros(30)])
    assert compute_turning_speed_mps(np.concatenate([lead_m, arc_m])) == pytest.approx(
        np.sqrt(TOWN.turning_mps2 * 6.0), rel=0.02
    )
    assert compute_turning_speed_mps(lead_m) > 100.0


def test_processor_time_of_programs_is_limited(tmp_path, monkeypatch):
    monkeypatch.setattr(simulating, "MAX_CPU_S", 0.5)
    with pytest.raises(ValueError, match=r"SUMO's netgenerate took more than 0\.5 s of processor time"):
        simulating.run_program("netgenerate", "--rand", "--rand.iterations", "9999999", "-o", tmp_path / "a.net.xml")
