"""Surface reference compared with a slow implementation: rays over directions, weighted by area."""

import numpy as np
import pytest
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from torch.quasirandom import SobolEngine

from torchcover.geometry import invert
from torchcover.simulation import Scenario, Simulator, SurfaceReference, sample_position_in_shell


def compute_visible_area(scene, place_m, box_m, rays, seed, max_range_m=250.0):
    """Compute visible surface points within a box from a position, with the area in m² of each.

    Rays aim at points sampled uniformly in the box, so that their density per solid angle is
    rays * (far^3 - near^3) / (3 volume), where near and far are the ranges at which they enter and leave the box. A hit
    at distance d represents d^2 / |cos| of surface per solid angle; |cos| is never clipped.
    """
    low, high = np.array(box_m, dtype=np.float64).T
    evenly = SobolEngine(3, scramble=True, seed=seed).draw(rays, dtype=torch.float64).numpy()
    way_m = low + (high - low) * evenly - place_m
    towards = (way_m / np.linalg.norm(way_m, axis=1, keepdims=True)).astype(np.float32)
    with np.errstate(divide="ignore"):
        ends_m = np.stack([(low - place_m) / towards, (high - place_m) / towards])
    near_m, far_m = ends_m.min(axis=0).max(axis=1).clip(min=0), ends_m.max(axis=0).min(axis=1)
    per_angle = rays * (far_m**3 - near_m**3) / (3 * np.prod(high - low))
    origins = np.repeat(np.asarray(place_m, dtype=np.float32)[None], rays, axis=0)
    hits = scene.run(origins, towards, output=True)
    range_m = hits["tfar"].astype(np.float64)
    points_m = place_m + range_m[:, None] * towards
    is_visible = (hits["geomID"] >= 0) & (hits["geomID"] != EGO) & (range_m <= max_range_m)
    is_visible &= ((points_m >= low) & (points_m < high)).all(axis=1)
    normals = hits["Ng"][is_visible].astype(np.float64)
    cosine = np.abs((normals * towards[is_visible]).sum(axis=1)) / np.linalg.norm(normals, axis=1)
    return points_m[is_visible], range_m[is_visible] ** 2 / (cosine * per_angle[is_visible])


def _build_scene(world, step):
    """Build the scene at one time in the vehicle frame, the ego first."""
    time_s = step * world.time_step_s
    vehicle_T_world = invert(world.ego.trajectory.interpolate(time_s))
    scene = EmbreeScene(robust=True)
    meshes = [world.ego.mesh, *(mesh.transform(vehicle_T_world) for mesh in world.static_meshes)]
    meshes += [actor.mesh.transform(vehicle_T_world @ actor.trajectory.interpolate(time_s)) for actor in world.objects]
    for mesh in meshes:
        TriangleMesh(scene, mesh.vertices_m.astype(np.float32), mesh.faces.astype(np.int32))
    return scene


EGO = 0
URBAN = {"name": "urban", "traffic": {"type": "urban", "duration_s": 2.0, "time_step_s": 0.5}}
AREA = ((0.0, 40.0), (-10.0, 10.0))
BANDS = ((-0.5, 0.5), (0.5, 2.0))


@pytest.mark.parametrize(("made", "seed"), [(Scenario.load("courtyard"), 0), (Scenario.model_validate(URBAN), 4)])
def test_both_references_measure_the_same_visible_area(made, seed, monkeypatch):
    positions = []

    def remembered(ego, shell_m, generator):
        positions.append(sample_position_in_shell(ego, shell_m, generator))
        return positions[-1]

    monkeypatch.setattr("torchcover.simulation.surface_reference.sample_position_in_shell", remembered)
    simulator = Simulator(made, {}, SurfaceReference((AREA,), num_rays=16_384, bands_m=BANDS), seed=seed)
    points, twins = [], []
    for index in range(8):
        positions.clear()
        step = simulator.simulate_frame(index)
        points.append((step.reference, step.reference_weights))
        scene, time_step = simulator.get_scene_geometry(index)
        twin = _build_scene(scene.scene, time_step)
        for place_m in positions[-4:]:
            points_m, m2 = compute_visible_area(twin, place_m, (*AREA, (-0.6, 2.1)), 2**15, seed=index)
            twins.append((points_m, m2 / 4))
    for low, high in BANDS:
        ours, theirs = (_compute_sums(found, low, high) for found in (points, twins))
        assert ours[0] == pytest.approx(theirs[0], rel=0.01)
        assert ours[1:] / ours[0] == pytest.approx(theirs[1:] / theirs[0], rel=0.01, abs=0.15)


def _compute_sums(points, low, high):
    """Compute the area in a band, and the area-weighted sums of the distance from the vehicle and of y."""
    points_m, m2 = (np.concatenate(part).astype(np.float64) for part in zip(*points, strict=True))
    m2 = m2 * (points_m[:, 2] >= low) * (points_m[:, 2] < high)
    # The box is slightly higher than the bands, since its rays are few at the borders.
    return np.array([m2.sum(), (m2 * np.linalg.norm(points_m, axis=1)).sum(), (m2 * points_m[:, 1]).sum()])
