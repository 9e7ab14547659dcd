"""Error against run time of the parts: search, lens inverse, ray casting, sums, cell size."""

import time
from functools import partial

import numpy as np
import torch
from kornia.geometry.calibration import undistort_points

from benchmarks.clouds import courtyard_clouds
from benchmarks.raycasting import bare_rays
from benchmarks.timing import table
from tests.stability.faces import EDGES, leaks
from tests.stability.rays import bare_embree, far_room, from_mid_room
from torchcover import BevGrid, CoverageMetric, Scenario, forward_regions, nearest
from torchcover.cameras import Camera, inverse
from torchcover.data import SimulatedFrames
from torchcover.evaluation import CoverageObserver, observe
from torchcover.simulation import PaperReference
from torchcover.simulation.scene import Scene
from torchcover.simulation.shapes import Mesh


def best(function, rounds=3):
    """Result and least time of some rounds."""
    seconds = []
    for _ in range(rounds):
        begin = time.perf_counter()
        result = function()
        seconds.append(time.perf_counter() - begin)
    return result, min(seconds)


# Search


def torch_cdist(query, points, mode):
    """(N,) distances by torch.cdist, 256 queries at a time."""
    return torch.cat([torch.cdist(q, points, compute_mode=mode).amin(dim=1) for q in query.split(256)])


def searches():
    query, points = courtyard_clouds(2048, 160_000)
    wide = query.double(), points.double()
    exact = nearest(*wide, backend="kdtree").distance
    product, difference = "use_mm_for_euclid_dist", "donot_use_mm_for_euclid_dist"
    ways = {
        "kdtree": lambda: nearest(query, points, backend="kdtree").distance,
        "kdtree, float64": lambda: nearest(*wide, backend="kdtree").distance,
        "cdist": lambda: nearest(query, points, backend="cdist").distance,
        "torch.cdist, products": lambda: torch_cdist(query, points, product),
        "torch.cdist, products, float64": lambda: torch_cdist(*wide, product),
        "torch.cdist, differences": lambda: torch_cdist(query, points, difference),
        "torch.cdist, differences, float64": lambda: torch_cdist(*wide, difference),
    }
    rows = []
    for name, way in ways.items():
        found, seconds = best(way, rounds=2)
        error = (found.double() - exact).abs()
        wrong = int(((found <= 0.4) != (exact <= 0.4)).sum())
        rows.append((name, seconds, float(error.max()), float(error.square().mean().sqrt()), wrong))
    print("### Search: 2,048 reference points, 160,000 sensor points\n")
    table(("way", "seconds", "largest error (m)", "RMS error (m)", "detections wrong"), rows)


# Lens

LENS = (1920, 1080, 930.0, 930.0, 991.0, 541.0, "brown_conrady", [-0.158, -0.027, -1.5e-4, 5.9e-4, 0.045])


def looked_up(rays, pixels):
    """The ray of the pixel centre that is nearest."""
    x, y = pixels.round().long().unbind(1)
    return rays[y, x]


def interpolated(rays, pixels):
    """Bilinear between the rays of four pixel centres."""
    low = pixels.floor().long()
    (x, y), (s, t) = low.unbind(1), (pixels - low)[:, None].unbind(2)
    top = rays[y, x] * (1 - s) + rays[y, x + 1] * s
    return top * (1 - t) + (rays[y + 1, x] * (1 - s) + rays[y + 1, x + 1] * s) * t


def newton(camera, pixels, steps):
    """As many steps of the solver, from its own start."""
    optics, (fx, fy, cx, cy) = camera._optics, camera.intrinsics.tolist()
    distortion, u, v = optics._solver.distortion, *((pixels.numpy() - [cx, cy]) / [fx, fy]).T
    start = inverse._first_guess(
        optics._region(distortion), optics._start_table(distortion, np.hypot(u, v)), u, v, np.hypot(u, v)
    )
    search = inverse._Search(distortion, optics._region(distortion), (fx, fy), u, v, *start)
    search.run(steps)
    return optics._solver.chart.lift(torch.from_numpy(search.a), torch.from_numpy(search.b))


def kornias(camera, pixels, iterations):
    fx, fy, cx, cy = camera.intrinsics.tolist()
    matrix = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
    plane = undistort_points(pixels, matrix, camera.coefficients, torch.eye(3, dtype=torch.float64), iterations)
    return torch.nn.functional.pad(plane, (0, 1), value=1.0)


def lenses():
    camera = Camera(*LENS)
    rays, made_s = best(lambda: Camera(*LENS).rays(dtype=torch.float64)[0], rounds=2)
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(1 << 18, 2, generator=generator, dtype=torch.float64) * torch.tensor([1918.0, 1078.0])
    ways = {
        "table at 1 px, nearest": partial(looked_up, rays, pixels),
        "table at 1 px, bilinear": partial(interpolated, rays, pixels),
        **{f"Newton, {n} steps": partial(newton, camera, pixels, n) for n in (0, 1, 2, 3)},
        "solved (`Camera.rays`)": lambda: camera.rays(pixels)[0],
        **{f"kornia, {n} iterations": partial(kornias, camera, pixels, n) for n in (1, 2, 5, 10, 20, 50)},
    }
    rows = []
    for name, way in ways.items():
        found, seconds = best(way)
        error = (camera._optics.pixels(found)[0] - pixels).norm(dim=1).nan_to_num(torch.inf)
        rows.append((name, 1000 * seconds / (len(pixels) / 1e6), float(error.median()), float(error.max())))
    print("### Lens inverse: 262,144 places between the pixels of a Brown-Conrady camera, 1920 x 1080\n")
    table(("way", "ms/Mpx", "median error (px)", "largest error (px)"), rows)
    print(f"\nThe table is made once: {made_s:.2f} s. At the pixels' centres it is the solution itself.")


# Ray casting


def casting():
    world = Scenario.load("courtyard").world()
    bodies = (world.ego.mesh, *world.static)
    sensor = PaperReference()
    pose = sensor.vehicle_T_reference(Scene(world).ego_box, np.random.default_rng(0))
    origin, towards = pose[:3, 3], np.concatenate([part[1] for part in bare_rays(sensor, pose)]).T

    def away(offset_m, meshes, origin_m, directions, robust):
        shift = np.array([offset_m, -offset_m, 0.0])
        moved = [Mesh(mesh.vertices_m + shift, mesh.faces) for mesh in meshes]
        return bare_embree(moved, np.asarray(origin_m) + shift, directions, robust)

    rows = []
    for frame, offset_m in (("local", 0.0), ("world, 1e5 m away", 1e5 + 0.3), ("world, 1e6 m away", 1e6 + 0.3)):
        for robust in (True, False):
            caster = partial(away, offset_m, robust=robust)
            _, seconds = best(partial(caster, bodies, origin, towards))
            room = partial(from_mid_room, partial(caster, far_room(0.0).static, [0.0, 0.0, 2.0]))
            rows.append((frame, "yes" if robust else "no", seconds, room(), leaks(EDGES, caster)))
    print("### Ray casting, one thread: Embree's robust flag and the frame that it works in\n")
    header = ("frame", "robust", "courtyard, 1,048,576 rays (s)", "error in a 60 m room (m)", "lost of 30,720 at edges")
    table(header, rows)


# Sums


def _add_plain(state, values):
    state[0] += values.astype(state[0].dtype)


def _add_kahan(state, values):
    """Kahan's: what the rounding of each sum loses is added to the next value."""
    total, lost = state
    corrected = values.astype(np.float32) - lost
    new = total + corrected
    state[1] = (new - total) - corrected
    state[0] = new


SUMS = {
    "float32": (lambda cells: [np.zeros(cells, np.float32)], _add_plain),
    "float32, Kahan": (lambda cells: [np.zeros(cells, np.float32) for _ in range(2)], _add_kahan),
    "float64": (lambda cells: [np.zeros(cells)], _add_plain),
}


def drift(start, add, steps, cells=64):
    """Largest relative error of the mean over the steps of radii between 0 and 1 m."""
    values = np.random.default_rng(0).uniform(size=(1000, cells))
    # Rounded as the sums take them: the error of the sums is asked for, not of the values.
    values = values.astype(np.float32).astype(np.float64)
    state = start(cells)
    for step in range(steps):
        add(state, values[step % 1000])
    exact = values.astype(np.longdouble).sum(axis=0) * (steps // 1000)
    return float((np.abs(state[0] - exact) / exact).max())


def one_step(start, add, wide, cells=51_200):
    """A function that bins the points of one step and adds the means to the sums."""
    generator = torch.Generator().manual_seed(0)
    cell = (torch.rand(1 << 18, generator=generator).square() * cells).long()
    radius, state = torch.rand(1 << 18, generator=generator), start(cells)

    def step():
        count = torch.bincount(cell, minlength=cells).clamp(min=1)
        total = torch.bincount(cell, weights=radius.double() if wide else radius, minlength=cells)
        add(state, (total / count).numpy())

    return step


def sums():
    rows = []
    for name, (start, add) in SUMS.items():
        errors = [drift(start, add, steps) for steps in (1_000, 10_000, 100_000)]
        _, seconds = best(one_step(start, add, wide=name == "float64"), rounds=30)
        rows.append((name, 1000 * seconds, *errors))
    print("### Sums over steps\n")
    header = ("sums", "ms a step (262,144 points, 51,200 cells)", *(f"error after {n}" for n in ("1e3", "1e4", "1e5")))
    table(header, rows)


# Cells


def cell_sizes(steps=24):
    frames = SimulatedFrames(
        "courtyard", "front_roof_128", steps=steps, reference_sensor=PaperReference(rows=512, columns=512)
    )
    kept = [frames[index] for index in range(steps)]
    rows = []
    for cell in (0.1, 0.25, 0.5, 1.0):
        grid = BevGrid(x=(0.0, 80.0), y=(-20.0, 20.0), cell=cell)
        metric = CoverageMetric(grid, max_radius=grid.diagonal_m)
        begin = time.perf_counter()
        observe(kept, [CoverageObserver(metric)])
        coverage = metric.compute()
        seconds = (time.perf_counter() - begin) / steps
        megabytes = sum(state.numel() * state.element_size() for state in metric.state_dict().values()) / 1e6
        numbers = []
        for row in coverage.summary(forward_regions((20.0, 80.0))):
            if row.height == "ground":
                numbers += [
                    f"{row.numbers['radius_m'].value:.3f}",
                    f"{row.numbers['detection_0.4m'].value:.3f}",
                    f"{row.known_share:.1%}",
                ]
        rows.append((f"{cell:g}", *numbers, f"{seconds:.3f}", f"{megabytes:.1f}"))
    print(f"### Cell size: courtyard, front_roof_128, {steps} steps of 512 x 512 reference rays, ground\n")
    regions = [f"{region}: {what}" for region in ("20 m", "80 m") for what in ("radius (m)", "detection", "known")]
    table(("cell (m)", *regions, "seconds a step", "state (MB)"), rows)


def main():
    """Print the tables."""
    for part in (searches, lenses, casting, sums, cell_sizes):
        part()
        print(flush=True)


if __name__ == "__main__":
    main()
