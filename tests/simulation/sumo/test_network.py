"""Valid and invalid networks of SUMO."""

import numpy as np
import pytest

from torchcover.files import BadFileError
from torchcover.simulation.sumo.network import read_network

from .towns import DRIVE, WALK, edge, street, write_net

LINE = [(0, 0, 1), (50, 0, 2)]
CONNECTED = '<connection from="a" to="b" fromLane="0" toLane="0"/><connection from="b" to="c" fromLane="0" toLane="0"/>'


def test_lane_uses_follow_vehicle_classes(tmp_path):
    lanes = [
        (WALK, 2, LINE), ('disallow="all" type="parking"', 2.3, LINE), ('disallow="all"', 1, LINE),
        ('allow="rail"', 3, LINE), ('allow="bicycle"', 1.5, LINE), (DRIVE, 3.2, LINE),
    ]  # fmt: skip
    path = write_net(
        tmp_path / "a.net.xml",
        edge("a", *lanes),
        edge(":j_c0", (WALK, 4, LINE), function="crossing"),
        edge(":j_w0", (WALK, 2, [(0, 0), (1, 0), (0, 1)]), function="walkingarea"),
        edge(":j_0", (DRIVE, 3, LINE), function="internal"),
        junctions=[[(0, 0), (5, 5), (5, 0), (0, 5)]],
    )
    network = read_network(path)
    uses = [lane.use for lane in network.lanes]
    assert uses == ["sidewalk", "bay", "shoulder", "road", "road", "crossing", "corner", "turn"]
    assert [lane.is_allowed("bicycle") for lane in network.lanes[:5]] == [False, False, False, True, True]
    assert [lane.is_allowed("passenger") for lane in network.lanes[:5]] == [False, False, False, False, True]
    np.testing.assert_array_equal(network.lanes[4].line_m, np.array(LINE, dtype=float))
    assert len(network.junctions) == 1


def test_successors_respect_vehicle_classes(tmp_path):
    path = write_net(
        tmp_path / "a.net.xml",
        edge("a", (DRIVE, 3, LINE)),
        edge("b", (DRIVE, 3, LINE)),
        edge("c", ('allow="bus"', 3, LINE)),
        more=CONNECTED,
    )
    network = read_network(path)
    assert network.find_successors("passenger") == {"a": ("b",), "b": ()}
    assert network.find_successors("bus") == {"a": ("b",), "b": ("c",), "c": ()}


def test_lanes_without_length_are_skipped_and_changes_read(tmp_path):
    path = write_net(tmp_path / "a.net.xml", street(), edge("short", (DRIVE, 3, [(7, 7), (7, 7)])))
    assert {lane.edge_id for lane in read_network(path).lanes} == {"east"}
    write_net(path, street(), street("another"))
    assert {lane.edge_id for lane in read_network(path).lanes} == {"east", "another"}


@pytest.mark.parametrize(
    ("edges", "message"),
    [
        ([edge("a", (DRIVE, -1, LINE))], "lane 'a_0': a width above 0 and up to 100 m is needed; got -1"),
        ([edge("a", (DRIVE, "nan", LINE))], "lane 'a_0': a width above 0"),
        ([edge("a", (DRIVE, "wide", LINE))], "lane 'a_0': width is 'wide', not a number"),
        ([edge("a", (DRIVE, 3, [(0, 0), ("nan", 1)]))], "lane 'a_0': its shape has NaN"),
        ([edge("a", (DRIVE, 3, [(0, 0), (1, 1, 1, 1)]))], "a shape of positions"),
        ([edge("a", (WALK, 3, LINE))], "a street for vehicles is needed; it has 1 lanes"),
        ([], "a street for vehicles is needed"),
    ],
)
def test_invalid_lanes_are_rejected_by_name(edges, message, tmp_path):
    with pytest.raises(BadFileError, match=f"a.net.xml: .*{message}"):
        read_network(write_net(tmp_path / "a.net.xml", *edges))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<routes/>", "begins with <net>; got <routes>"),
        ("<!DOCTYPE n [<!ENTITY a 'aaaa'>]><net>&a;</net>", "without entities"),
        ("<net>", "no element found"),
    ],
)
def test_invalid_networks_are_rejected(text, message, tmp_path):
    path = tmp_path / "a.net.xml"
    path.write_text(text)
    with pytest.raises(BadFileError, match=f"a.net.xml: .*{message}"):
        read_network(path)
    with pytest.raises(FileNotFoundError, match=r"b\.net\.xml"):
        read_network(tmp_path / "b.net.xml")
