"""Height bands over z of the vehicle and over the local ground, beside each other at the same instants."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.instants import CITIES, HEIGHTS, REGIONS, Way, estimates, frames_of, in_two_processes, measured
from benchmarks.timing import table
from tests.simulation.recorded import drives
from torchcover.geometry import invert, transform
from torchcover.report import ColourScale, draw_side_by_side
from torchcover.simulation import Scenario

FRAMES = {"vehicle": "z of the vehicle", "ground": "the local ground"}
FLAT_CITY = {"name": "flat", "traffic": {"type": "urban", "hills_m": 0.0}}
STRAIGHT = Path(__file__).parents[1] / "examples" / "paper" / "straight.yaml"
# What a world is called, and its scenario, seed and which one it is the flat twin of.
WORLDS = {
    "`urban`, seed 0": ("urban", 0, None),
    "`urban`, seed 4242": ("urban", 4242, None),
    "`urban`, seed 31337": ("urban", 31337, None),
    "seed 0 without hills": (FLAT_CITY, 0, "`urban`, seed 0"),
    "seed 4242 without hills": (FLAT_CITY, 4242, "`urban`, seed 4242"),
    "straight and level": (STRAIGHT, 0, None),
    "`tracks_argoverse2`": ("tracks_argoverse2", 0, None),
    "the same drive on a plain": ("plain", 0, "`tracks_argoverse2`"),
    "`highway`": ("highway", 0, None),
}
OUT = Path("out/heights")
MAP_CELLS = 2
DRIVE_SEED, DRIVE_STEPS, DRIVE_POINTS, NEAR_M = 5, 100, 100_000, 160.0


def main():
    found = dict(zip(WORLDS, in_two_processes(of_world, WORLDS), strict=True))
    numbers = {world: numbers for world, (numbers, _) in found.items()}
    for place in (("160m", "obstacle"), ("80m", "obstacle"), ("20m", "obstacle"), ("80m", "ground")):
        print(f"### {place[0].removesuffix('m')} m {place[1]}\n")
        heading = [f"{what}: {words}" for what in ("detection (%)", "radius (m)") for words in FRAMES.values()]
        rows = []
        for world, of_frame in numbers.items():
            each = [list(of_frame[frame][place].numbers().values()) for frame in FRAMES]
            cells = [shown(one[kind]) for kind in (1, 0) for one in each]
            ratios = [(one.error / other.error) ** 2 for one, other in zip(*each, strict=True)]
            rows.append((world, *cells[:2], f"{ratios[1]:.1f}", *cells[2:], f"{ratios[0]:.1f}"))
        table(("world", *heading[:2], "variances", *heading[2:], "variances"), rows)
        print()
    print("### Hills less plain: detection (points)\n")
    twins = {world: twin for world, (*_, twin) in WORLDS.items() if twin}
    rows = []
    for place in ((region.name, height) for region in REGIONS for height in HEIGHTS):
        of_place = [
            numbers[hilly][frame][place].differences(numbers[flat][frame][place])
            for frame in FRAMES
            for flat, hilly in twins.items()
        ]
        rows.append((" ".join(place), *(shown_difference(list(one.values())[1]) for one in of_place)))
    table(("place", *(f"{hilly}: {words}" for words in FRAMES.values() for hilly in twins.values())), rows)
    print()
    draw_maps(found["`urban`, seed 0"][1])
    drive()


def scenario_of(given, folder):
    """A scenario by its name or its document; of tracks only what was recorded, and the plain drive is written down."""
    if given == "plain":
        drives.write_argoverse2(Path(folder) / "log", heights=drives.flat_m)
        given = {"name": "plain", "traffic": {"type": "tracks", "path": str(Path(folder) / "log")}}
    found = Scenario.model_validate(given) if isinstance(given, dict) else Scenario.load(given)
    recorded = found.traffic is not None and found.traffic.type == "tracks"
    bare = {"traffic": found.traffic.model_copy(update={"built_share": None})} if recorded else {}
    return found.model_copy(update=bare)


def of_world(world):
    """Band frame -> (region, height) -> estimate; band frame -> (H, Y, X) visible square metres of a step, grid."""
    given, seed, _ = WORLDS[world]
    with tempfile.TemporaryDirectory() as folder:
        frames = frames_of(scenario_of(given, folder), cities=CITIES, seed=seed)
        coverages = measured(frames, {band_frame: Way.of(band_frame) for band_frame in FRAMES})
    maps = {}
    for band_frame, coverage in coverages.items():
        maps[band_frame] = coverage.area.totals()[0] / coverage.counts["steps"], coverage.grid
    return {band_frame: estimates(coverage) for band_frame, coverage in coverages.items()}, maps


def shown(number):
    scale, digits = (100, 1) if number.quantity.unit == "share" else (1, 2)
    value, low, high = (f"{scale * each:.{digits}f}" for each in (number.value, number.low, number.high))
    return f"{value} [{low}, {high}]"


def shown_difference(difference):
    return f"{100 * difference.value:+.1f} [{100 * difference.low:+.1f}, {100 * difference.high:+.1f}]"


def draw_maps(maps):
    """How much of the obstacle band is visible, both ways, in `OUT`."""
    OUT.mkdir(parents=True, exist_ok=True)
    _, fine = next(iter(maps.values()))
    figure = draw_side_by_side(
        {f"bands over {FRAMES[frame]}": pooled(m2[HEIGHTS.index("obstacle")]) for frame, (m2, _) in maps.items()},
        replace(fine, cell=MAP_CELLS * fine.cell),
        ColourScale("visible surface in each 4 m2 and step", "m2", "viridis", 0.0, 0.5),
        title="What counts as an obstacle in a city with hills",
        subtitle="0.5 to 2 m above the vehicle's plane, and above the local ground",
    )
    figure.savefig(OUT / "maps.png", dpi=75)


def pooled(sums):
    """The sums of squares of cells."""
    return torch.nn.functional.avg_pool2d(sums[None], MAP_CELLS)[0] * MAP_CELLS**2


def drive():
    """Does a surface that never moves stay in its band while the vehicle drives on?"""
    frames = frames_of("urban", cities=1, seed=DRIVE_SEED, every_s=0.1)
    scene, _ = frames.simulator.scene_of(0)
    ego, step_s = scene.world.ego.trajectory, scene.world.time_step_s
    poses = [ego.at(step * step_s) for step in range(DRIVE_STEPS)]
    points_m = static_points(scene.world.static, np.array([pose[:3, 3] for pose in poses]))
    bands = {frame: [] for frame in FRAMES}
    for pose in poses:
        in_vehicle_m = transform(invert(pose), points_m).astype(np.float32)
        heights_m = {"vehicle": in_vehicle_m[:, 2], "ground": scene.ground.heights_m(in_vehicle_m, pose)}
        for frame, height_m in heights_m.items():
            bands[frame].append(np.digitize(height_m, (-0.5, 0.5, 2.0)))
    rows, pictures = [], {}
    for frame, words in FRAMES.items():
        of_steps = np.stack(bands[frame])
        changes = (of_steps != of_steps[0]).any(axis=0)
        rows.append((words, f"{changes.sum():,}", f"{100 * changes.mean():.2f}"))
        pictures[words] = of_steps[0], changes
    climb_m = np.ptp([pose[2, 3] for pose in poses])
    way_m = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    print(f"### {DRIVE_STEPS} steps, {way_m:.0f} m of a street that climbs {climb_m:.1f} m\n")
    table(("bands over", f"of {len(points_m):,} points change their band", "%"), rows)
    draw_drive(points_m, poses, pictures)


def static_points(meshes, path_m):
    """(N, 3) points drawn evenly on what never moves and is near where the vehicle drives."""
    corners_m = np.concatenate([mesh.vertices_m[mesh.faces] for mesh in meshes])
    across = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    m2 = np.linalg.norm(across, axis=1) / 2
    generator = np.random.default_rng(0)
    face = generator.choice(len(m2), size=20 * DRIVE_POINTS, p=m2 / m2.sum())
    first, second = generator.uniform(size=(2, len(face)))
    over = first + second > 1
    first[over], second[over] = 1 - first[over], 1 - second[over]
    shares = np.stack([1 - first - second, first, second], axis=1)
    points_m = np.einsum("nc,ncd->nd", shares, corners_m[face])
    middle_m = path_m[len(path_m) // 2]
    near = np.abs(points_m - middle_m)[:, :2].max(axis=1) < NEAR_M
    low = np.abs(points_m[:, 2] - middle_m[2]) < 6.0
    return points_m[near & low][:DRIVE_POINTS]


def draw_drive(points_m, poses, pictures):
    """From above and from the side: the band at the first step, and what changes its band later."""
    figure = Figure(figsize=(13.0, 11.0), dpi=75, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 2, height_ratios=(3, 1.2), sharex=True, sharey="row")
    ahead = poses[-1][:2, 3] - poses[0][:2, 3]
    ahead /= np.linalg.norm(ahead)
    local_m = points_m - poses[0][:3, 3]
    along_m, aside_m = local_m[:, :2] @ ahead, local_m[:, :2] @ np.array([-ahead[1], ahead[0]])
    path_m = np.array([pose[:3, 3] for pose in poses]) - poses[0][:3, 3]
    for column, (words, (band, changes)) in enumerate(pictures.items()):
        for row, (across_m, label) in enumerate(((aside_m, "y left (m)"), (local_m[:, 2], "z up (m)"))):
            axes = panels[row, column]
            for number, (name, colour) in enumerate(
                (("below", "black"), ("ground", "#b9b9b9"), ("obstacle", "#2a7fb8"))
            ):
                chosen = (band == number) & ~changes & (np.abs(aside_m) < (20.0 if row else np.inf))
                axes.scatter(along_m[chosen], across_m[chosen], s=0.6, c=colour, linewidths=0, label=name)
            chosen = changes & (np.abs(aside_m) < (20.0 if row else np.inf))
            axes.scatter(along_m[chosen], across_m[chosen], s=0.6, c="#d62728", linewidths=0, label="changes its band")
            axes.plot(
                path_m[:, :2] @ ahead, path_m[:, 2] if row else path_m[:, :2] @ np.array([-ahead[1], ahead[0]]), "k-"
            )
            axes.set(xlabel="x forward (m)", ylabel=label)
            if not row:
                axes.set_title(f"bands over {words}")
                axes.legend(markerscale=10, loc="lower right")
    figure.savefig(OUT / "drive.png", dpi=75)


if __name__ == "__main__":
    main()
