"""Meshes of scenery are closed and have the right size and position."""

import numpy as np
import pytest
import trimesh

from torchcover.simulation.traffic.scenery import (
    build_box,
    build_box_from_bounds,
    build_ground_plane,
    build_post,
    build_prism,
    build_rectangle,
    build_tree,
    merge_by_kind,
)

TREE = build_tree((1.0, 2.0), 0.15, 2.5, 7.0, 1.5)
PIECES = {
    "block": (build_box_from_bounds((1.0, 3.0), (-2.0, 2.0), (0.0, 5.0)), 2 * 4 * 5),
    "box": (build_box((5.0, 5.0), (2.0, 3.0, 4.0), 1.0, 35.0), 2 * 3 * 4),
    "post": (build_post((1.0, 1.0), 0.1, 0.0, 3.0), 6 / 2 * np.sin(np.pi / 3) * 0.01 * 3),
    "trunk": (TREE[0], 6 / 2 * np.sin(np.pi / 3) * 0.15**2 * 2.5),
    "pyramid": (
        build_prism([build_rectangle((-1, 1), (-1, 1)), build_rectangle((-0.5, 0.5), (-0.5, 0.5))], [0.0, 3.0]),
        7.0,
    ),
}


@pytest.mark.parametrize("name", PIECES)
def test_scenery_meshes_are_closed_with_exact_volume(name):
    mesh, volume = PIECES[name]
    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    assert solid.is_volume
    assert solid.volume == pytest.approx(volume)


def test_tree_crown_is_closed_above_its_trunk():
    crown = trimesh.Trimesh(TREE[1].vertices_m, TREE[1].faces, process=False)
    assert crown.is_volume
    assert TREE[1].vertices_m[:, 2].min() == pytest.approx(TREE[0].vertices_m[:, 2].max())
    assert TREE[1].vertices_m[:, 2].max() == pytest.approx(7.15)
    assert np.linalg.norm(TREE[1].vertices_m[:, :2] - [1, 2], axis=1).max() == pytest.approx(1.5)


def test_ground_covers_corners_and_kinds_are_merged():
    mesh = build_ground_plane((-5.0, -1.0), (5.0, 1.0))
    assert np.ptp(mesh.vertices_m, axis=0).tolist() == [10.0, 2.0, 0.0]
    merged = merge_by_kind([PIECES["block"][0], PIECES["box"][0]], [], [TREE[0]])
    assert [len(m.faces) for m in merged] == [24, 20]
