"""Compare metrics with detector performance over random placements: `python -m examples.placement_benchmark`.

Two LiDARs with a fixed number of rays are mounted at random positions on the SUV. The detector of
`examples/train_detector.py` is trained on the frames of each placement with several seeds, and the ranking by its
average precision on held-out frames is compared with the rankings by torchcover's numbers and by published metrics. The
correlation between seeds is an upper bound for every metric.

Each finished training is a line in OUT/trainings.jsonl; the same command continues an interrupted run. The full size
takes hours on two cores; `--reduced` only tests that the example works. Needs
`pip install 'torchcover[lightning,tensorboard]'`.
"""

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from examples.train_detector import (
    MATCH_M,
    MIN_POINTS,
    SCORES,
    X_M,
    Y_M,
    Detector,
    compute_average_precision,
    compute_loss,
    decode,
    select_cars_in_region,
    thin_cloud,
)
from torchcover import Region
from torchcover.contrib import (
    PlacementRatings,
    compare_correlations,
    correlate_rankings,
    parse_metric_names,
    score_placements,
)
from torchcover.contrib.ranks import LEAST
from torchcover.data import Augmentation, SimulatedFrames
from torchcover.detection import RecallByVisibility
from torchcover.simulation import PaperReference, Rig

# Bounds of the mounting positions, x, y, z in meters: on the roof of the SUV, and at its front and sides.
MOUNTS_M = {
    "roof": ((-1.4, -0.2), (-0.5, 0.5), (1.75, 2.35)),
    "front": ((2.5, 2.6), (-0.8, 0.8), (0.5, 1.1)),
    "left": ((-1.0, 1.4), (1.05, 1.15), (0.6, 1.3)),
    "right": ((-1.0, 1.4), (-1.15, -1.05), (0.6, 1.3)),
}
MAX_TILT_DEG = 8.0
LIDAR = {
    "channels": 16,
    "columns": 500,
    "horizontal_fov_deg": 360.0,
    "vertical_fov_deg": [-24.8, 2.0],
    "max_range_m": 100.0,
}
LIDARS = 2
BATCH = 4
FRAME_INTERVAL_S = 15.0
# Each frame of the metrics shows a different scene, because standard errors are computed over scenes.
METRIC_FRAME_INTERVAL_S = 60.0
REDUCED = {"placements": 3, "seeds": 2, "train": 4, "validate": 4, "epochs": 1, "num_frames": 2}


def sample_placements(count, seed):
    """Sample rigs with LiDARs at random positions; a rig depends on the seed and its index only.

    Every other rig has all LiDARs on the roof, where rigs differ less, as in practice.
    """
    rigs = {}
    for number in range(count):
        generator = np.random.default_rng([seed, number])
        lidars = []
        for k in range(LIDARS):
            region = MOUNTS_M["roof" if number % 2 == 0 else generator.choice(list(MOUNTS_M))]
            position = (round(float(generator.uniform(*bounds)), 3) for bounds in region)
            tilt = generator.uniform(-MAX_TILT_DEG, MAX_TILT_DEG, 2).round(2).tolist()
            mount = dict(zip(("x_m", "y_m", "z_m", "pitch_deg", "roll_deg"), (*position, *tilt), strict=True))
            lidars.append({"type": "lidar", "name": f"lidar_{k}", "mount": mount, **LIDAR})
        name = f"{'roof' if number % 2 == 0 else 'anywhere'}_{number:02d}"
        rigs[name] = Rig.model_validate({"name": name, "description": "Sampled at random.", "sensors": lidars})
    return rigs


def simulate(rigs, num_frames, seed, name):
    """Simulate the same frames for all rigs, four per drive of one minute, with the input of the detector."""
    frames = SimulatedFrames(
        "urban",
        rigs=rigs,
        num_frames=num_frames,
        seed=seed,
        frame_interval_s=FRAME_INTERVAL_S,
        reference_sensor=PaperReference(rows=1, columns=1),  # not used
        boxes=True,
    )
    prepared = []
    for index in track(range(num_frames), description=f"simulating {name}", console=Console(stderr=True)):
        frame = frames[index]
        clouds = {rig: thin_cloud(frame.get_measured_points(rig)) for rig in frame.clouds}
        prepared.append(
            replace(
                frame,
                clouds=clouds,
                measurements={},
                boxes=select_cars_in_region(frame.boxes),
                sensor_point_counts=None,
            )
        )
    return prepared


def train_detector(rig, frames, epochs, seed):
    """Train a detector on the frames of one rig."""
    torch.manual_seed(seed)
    detector, augment = Detector(), Augmentation(max_yaw_rad=np.deg2rad(15.0), seed=seed)
    rig_frames = [replace(frame, clouds={rig: frame.clouds[rig]}) for frame in frames]
    batches = len(rig_frames) // BATCH
    optimizer = torch.optim.AdamW(detector.parameters(), lr=1e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=3e-3, total_steps=epochs * batches)
    for epoch in range(epochs):
        order = torch.randperm(len(rig_frames))[: batches * BATCH].view(batches, BATCH).tolist()
        for indices in order:
            batch = [augment(rig_frames[index], epoch) for index in indices]
            ground_truth = []
            for frame in batch:
                ground_truth.append(frame.boxes.select(frame.boxes.points_in_box[rig] >= MIN_POINTS).rows)
            loss = compute_loss(*detector([frame.clouds[rig] for frame in batch]), ground_truth)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return detector.eval()


@torch.no_grad()
def evaluate_detector(detector, rig, frames):
    """Compute the average precision on all cars of the frames, visible or not."""
    recall = RecallByVisibility(threshold=MATCH_M, score_thresholds=SCORES)
    for frame in frames:
        (heat,), (boxes,) = detector([frame.clouds[rig]])
        rows, scores = decode(heat, boxes)
        recall.update(rows, frame.boxes, torch.ones(len(frame.boxes)), scores)
    return compute_average_precision(recall.compute())


def read_finished_trainings(path):
    """Read the average precision of the finished trainings, by placement and seed."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("\n")]  # the last line may be incomplete
    return {(record["placement"], record["seed"]): record["ap"] for record in records}


def append_line(path, line):
    """Append a line atomically: after a kill it is complete or ignored."""
    content = path.read_bytes() if path.exists() else b""
    with path.open("r+b" if content else "wb") as file:
        file.seek(content.rfind(b"\n") + 1)  # overwrites an incomplete line
        file.truncate()
        file.write(json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def train_all(rigs, options, path):
    """Run the missing trainings; returns the average precision (seeds, placements)."""
    missing = [
        (rig, seed) for seed in range(options.seeds) for rig in rigs if (rig, seed) not in read_finished_trainings(path)
    ]  # seed by seed, so that partial results can be ranked
    if missing:
        missing_rigs = {rig: rigs[rig] for rig in dict.fromkeys(rig for rig, _ in missing)}
        training = simulate(missing_rigs, options.train, options.seed, "training frames")
        held_out = simulate(missing_rigs, options.validate, options.seed + 1, "held-out frames")
        for rig, seed in track(missing, description="training", console=Console(stderr=True)):
            detector = train_detector(rig, training, options.epochs, seed)
            append_line(path, {"placement": rig, "seed": seed, "ap": evaluate_detector(detector, rig, held_out)})
    precisions = read_finished_trainings(path)
    return np.array([[precisions[rig, seed] for rig in rigs] for seed in range(options.seeds)])


def check_settings(options, path):
    """Reject a folder with trainings of other settings."""
    settings = {name: value for name, value in vars(options).items() if name not in ("out", "reduced")}
    if not path.exists():
        path.write_text(json.dumps(settings, indent=1), encoding="utf-8")
    earlier = json.loads(path.read_text(encoding="utf-8"))
    # Settings that do not change a training.
    free = ("placements", "seeds", "num_frames", "metrics")
    if different := [name for name in settings if earlier.get(name) != settings[name] and name not in free]:
        differences = ", ".join(f"{name} {earlier.get(name)} (now {settings[name]})" for name in different)
        raise SystemExit(f"{path.parent} contains trainings with {differences}; choose another --out")


def build_page(ratings, scores, options):
    """Build the page of the results in Markdown."""
    trainings = f"{options.seeds} training{'s' * (options.seeds > 1)} of each"
    text = (
        f"{len(ratings.placements)} placements of {LIDARS} LiDARs ({LIDAR['channels']} channels, {LIDAR['columns']} "
        f"columns each), {trainings} on {options.train} frames in {options.epochs} epochs, average precision of cars "
        f"on {options.validate} held-out frames; metrics on {options.num_frames} other frames. Spearman's rho and "
        "Kendall's tau-b with the mean of the trainings, with 95 % bootstrap intervals over placements, trainings and "
        "scenes (*: not over scenes); two-sided p-values; the lead is the difference between Spearman's rho and "
        "that of the mean mounting height.\n\n"
    )
    roof_names = [name for name in ratings.placements if name.startswith("roof")]
    for heading, names in (("All placements", ratings.placements), ("Placements on the roof", roof_names)):
        if len(names) >= LEAST:
            text += f"## {heading}\n\n{build_table(ratings.select(names), scores.select(names))}\n"
    text += f"## Average precision\n\n| placement | LiDARs at x, y, z (m) | {' | '.join(ratings.raters)} |\n"
    text += "|---|---|" + "---:|" * len(ratings.raters) + "\n"
    rigs = sample_placements(len(ratings.placements), options.seed)
    for name, column in zip(ratings.placements, ratings.values.T, strict=True):
        mounts = [sensor.mount for sensor in rigs[name].sensors]
        positions = "; ".join(f"{mount.x_m:.2f}, {mount.y_m:.2f}, {mount.z_m:.2f}" for mount in mounts)
        text += f"| {name} | {positions} | {' | '.join(f'{ap:.3f}' for ap in column)} |\n"
    return text


def build_table(ratings, rankings):
    """Build the table of rank correlations for some placements."""
    result = correlate_rankings(rankings, ratings, resample_placements=True)
    (height,) = (ranking for ranking in rankings if ranking.name == "mean mounting height")
    ceiling = f"{ratings.inter_rater_correlation:.2f}" if len(ratings.raters) > 1 else "unknown (one training of each)"
    text = (
        f"Correlation between trainings: {ceiling}, on {len(ratings.placements)} placements, whose "
        f"average precision is {ratings.mean.min():.3f} to {ratings.mean.max():.3f}. The best of {result.metric_count} "
        f"metrics is `{result.best_metric}`, p = {result.best_p_value:.2g} corrected for the selection; in one of "
        f"twenty cases, the best metric has a correlation above {result.chance_threshold:.2f} by chance.\n\n"
        "| metric | Spearman | tau-b | p | lead |\n|---|---:|---:|---:|---:|\n"
    )
    order = sorted(
        zip(result.correlations, rankings, strict=True), key=lambda pair: -np.nan_to_num(pair[0].spearman.value)
    )
    leads = []
    for row, ranking in order:
        if np.isnan(row.spearman.value):
            continue
        lead = compare_correlations(ranking, height, ratings, resample_placements=True)
        leads += [ranking.name] if lead.low > 0 else []
        name = f"{row.metric}{'' if row.resamples_scenes else ' *'}"
        text += f"| {name} | {row.spearman.text} | {row.kendall.text} | {row.p_value:.2g} | {lead.text} |\n"
    better = ", ".join(f"`{name}`" for name in leads) or "none"
    return f"{text}\nSignificantly better than the mean mounting height: {better}.\n"


def main():
    """Train the detectors, compute the metrics and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--placements", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=4, help="trainings of each placement")
    parser.add_argument("--train", type=int, default=192, help="number of training frames")
    parser.add_argument("--validate", type=int, default=96, help="number of held-out frames, four per drive")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--num-frames", type=int, default=96, help="number of frames for the metrics")
    parser.add_argument("--metrics", default="all", help="published metrics, such as `k_cover,point_density`")
    parser.add_argument("--seed", type=int, default=0, help="seed of placements and traffic")
    parser.add_argument("--reduced", action="store_true", help=f"only test that the example works: {REDUCED}")
    parser.add_argument("--out", type=Path, default=Path("out/placement_benchmark"))
    options = parser.parse_args()
    if options.reduced:
        vars(options).update(REDUCED)
    options.out.mkdir(parents=True, exist_ok=True)
    check_settings(options, options.out / "settings.json")
    rigs = sample_placements(options.placements, options.seed)
    values = train_all(rigs, options, options.out / "trainings.jsonl")
    raters = tuple(f"seed {seed}" for seed in range(options.seeds))
    ratings = PlacementRatings("average precision", tuple(rigs), raters, values)
    scores = score_placements(
        rigs,
        "urban",
        region=Region("region of the detector", X_M, Y_M),
        metrics=parse_metric_names(options.metrics),
        num_frames=options.num_frames,
        seed=options.seed + 2,
        frame_interval_s=METRIC_FRAME_INTERVAL_S,
        progress=True,
    )
    text = build_page(ratings, scores, options)
    (options.out / "placement_benchmark.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
