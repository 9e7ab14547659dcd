"""What imperfect sensors cover, and how much more the same would seem to cover by where its points landed.

The second is all that a recording knows: the same cloud as clouds of one's own, in the same frames of `urban`.
"""

import torch

from benchmarks.timing import table
from torchcover import BevGrid, CoverageMetric
from torchcover.data import SimulatedFrames
from torchcover.simulation import Rig

STEPS, EVERY_S = 12, 15.0
GRID = BevGrid(x=(0.0, 80.0), y=(-20.0, 20.0), band_frame="ground")
LIDAR, CAMERAS = "front_roof_128", "three_cameras"
IMPERFECT = {
    LIDAR: [{}, *({"range_noise_m": sigma_m} for sigma_m in (0.03, 0.1, 0.5, 3.0)), {"dropout": 0.3}],
    CAMERAS: [{}, {"range_noise_share": 0.05}, {"stereo": {"baseline_m": 0.3, "subpixel_px": 0.25}}],
}


def main():
    """Print detection within 80 m, by area."""
    torch.set_num_threads(1)
    rigs = {f"{name}: {words(keys)}": imperfect(name, keys) for name, each in IMPERFECT.items() for keys in each}
    frames = SimulatedFrames("urban", rigs=rigs, steps=STEPS, every_s=EVERY_S, seed=0)
    metrics = {(rig, landed): CoverageMetric(GRID, square_metres=True) for rig in rigs for landed in (False, True)}
    for frame in frames:
        for (rig, landed), metric in metrics.items():
            points, error = (frame.landed(rig), None) if landed else (frame.cloud_of(rig), frame.error_of(rig))
            surface = {"weights": frame.reference_weights, "height": frame.reference_heights_m}
            metric.update(points, frame.reference, error=error, **surface)
    percent = {key: [f"{100 * value:.1f}" for value in detection(metric)] for key, metric in metrics.items()}
    rows = [(*rig.split(": ", 1), *percent[rig, False], *percent[rig, True]) for rig in rigs]
    table(
        ("rig", "what is imperfect", "ground (%)", "obstacle (%)", "ground, landed (%)", "obstacle, landed (%)"), rows
    )


def words(keys):
    return ", ".join(f"{key} {value}" for key, value in keys.items()).replace("'", "") or "nothing"


def imperfect(name, keys):
    """A built-in rig whose sensors all have some more keys."""
    document = Rig.load(name).model_dump(exclude_unset=True)
    return Rig.model_validate({**document, "sensors": [{**sensor, **keys} for sensor in document["sensors"]]})


def detection(metric):
    """Of the ground, and of obstacles."""
    rows = {(row.region, row.height): row for row in metric.compute().summary()}
    return [rows["80m", height].numbers["detection_0.4m"].value for height in ("ground", "obstacle")]


if __name__ == "__main__":
    main()
