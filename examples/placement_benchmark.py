"""Which metric ranks sensor placements as a detector does: `python -m examples.placement_benchmark`.

Two LiDARs go to random places on the SUV, always with the same rays. The small detector of `examples/train_detector.py`
is trained on the frames of each placement, several times from different seeds, and its average precision on held-out
frames is ranked against torchcover's numbers and against the metrics of others. How well the seeds agree with each
other is the most that any metric can reach. A training that is finished is a line in OUT/trainings.jsonl: run the same
command again after whatever ended it, and it goes on. At full size it takes hours on two cores; `--reduced` shows that
it works, and nothing else. Needs `pip install 'torchcover[lightning,tensorboard]'`, as the example that it builds on.
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
    MIN_HITS,
    SCORES,
    X_M,
    Y_M,
    Detector,
    average_precision,
    decode,
    in_region,
    loss_of,
    thinned,
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

# Where a LiDAR may be: x, y, z in metres, on the SUV's roof, before its front, and beside its left and right flank.
MOUNTS_M = {
    "roof": ((-1.4, -0.2), (-0.5, 0.5), (1.75, 2.35)),
    "front": ((2.5, 2.6), (-0.8, 0.8), (0.5, 1.1)),
    "left": ((-1.0, 1.4), (1.05, 1.15), (0.6, 1.3)),
    "right": ((-1.0, 1.4), (-1.15, -1.05), (0.6, 1.3)),
}
MOST_TILT_DEG = 8.0
LIDAR = {
    "channels": 16,
    "columns": 500,
    "horizontal_fov_deg": 360.0,
    "vertical_fov_deg": [-24.8, 2.0],
    "max_range_m": 100.0,
}
LIDARS = 2
BATCH = 4
SECONDS_APART = 15.0
# Each step of the metrics shows another city: worlds are what their errors are over.
WORLD_S = 60.0
REDUCED = {"placements": 3, "seeds": 2, "train": 4, "validate": 4, "epochs": 1, "num_frames": 2}


def placements(count, seed):
    """Rigs of LiDARs of one kind at random places, by their names; a rig depends on the seed and its number alone.

    Every other one has all its LiDARs on the roof: these differ less, as do the rigs that an engineer chooses from.
    """
    rigs = {}
    for number in range(count):
        generator = np.random.default_rng([seed, number])
        lidars = []
        for k in range(LIDARS):
            where = MOUNTS_M["roof" if number % 2 == 0 else generator.choice(list(MOUNTS_M))]
            place = (round(float(generator.uniform(*bounds)), 3) for bounds in where)
            tilt = generator.uniform(-MOST_TILT_DEG, MOST_TILT_DEG, 2).round(2).tolist()
            mount = dict(zip(("x_m", "y_m", "z_m", "pitch_deg", "roll_deg"), (*place, *tilt), strict=True))
            lidars.append({"type": "lidar", "name": f"lidar_{k}", "mount": mount, **LIDAR})
        name = f"{'roof' if number % 2 == 0 else 'anywhere'}_{number:02d}"
        rigs[name] = Rig.model_validate({"name": name, "description": "Drawn at random.", "sensors": lidars})
    return rigs


def simulate(rigs, steps, seed, name):
    """The same instants for all rigs, 4 from each drive of a minute, with what the detector is fed."""
    frames = SimulatedFrames(
        "urban",
        rigs=rigs,
        num_frames=steps,
        seed=seed,
        frame_interval_s=SECONDS_APART,
        reference_sensor=PaperReference(rows=1, columns=1),  # which nobody looks at
        boxes=True,
    )
    kept = []
    for index in track(range(steps), description=f"simulating {name}", console=Console(stderr=True)):
        frame = frames[index]
        clouds = {rig: thinned(frame.get_measured_points(rig)) for rig in frame.clouds}
        kept.append(
            replace(frame, clouds=clouds, measurements={}, boxes=in_region(frame.boxes), sensor_point_counts=None)
        )
    return kept


def trained(rig, frames, epochs, seed):
    """A detector that has seen the frames of one rig."""
    torch.manual_seed(seed)
    detector, augment = Detector(), Augmentation(max_yaw_rad=np.deg2rad(15.0), seed=seed)
    mine = [replace(frame, clouds={rig: frame.clouds[rig]}) for frame in frames]
    batches = len(mine) // BATCH
    optimizer = torch.optim.AdamW(detector.parameters(), lr=1e-3, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=3e-3, total_steps=epochs * batches)
    for epoch in range(epochs):
        order = torch.randperm(len(mine))[: batches * BATCH].view(batches, BATCH).tolist()
        for numbers in order:
            batch = [augment(mine[number], epoch) for number in numbers]
            truth = [frame.boxes.select(frame.boxes.points_in_box[rig] >= MIN_HITS).rows for frame in batch]
            loss = loss_of(*detector([frame.clouds[rig] for frame in batch]), truth)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return detector.eval()


@torch.no_grad()
def tested(detector, rig, frames):
    """Average precision on all cars of some frames, seen or not."""
    recall = RecallByVisibility(threshold=MATCH_M, score_thresholds=SCORES)
    for frame in frames:
        (heat,), (boxes,) = detector([frame.clouds[rig]])
        rows, scores = decode(heat, boxes)
        recall.update(rows, frame.boxes, torch.ones(len(frame.boxes)), scores)
    return average_precision(recall.compute())


def finished(path):
    """Average precision of each training that has a whole line, by placement and seed."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True) if path.exists() else []
    found = [json.loads(line) for line in lines if line.endswith("\n")]  # a kill may have cut the last one
    return {(each["placement"], each["seed"]): each["ap"] for each in found}


def append(path, line):
    """Add a line that is whole, or not there, whatever happens."""
    whole = path.read_bytes() if path.exists() else b""
    with path.open("r+b" if whole else "wb") as file:
        file.seek(whole.rfind(b"\n") + 1)  # over what a kill left of a line
        file.truncate()
        file.write(json.dumps(line).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())


def train_all(rigs, options, path):
    """Train what is not finished; average precision (seeds, placements)."""
    missing = [
        (rig, seed) for seed in range(options.seeds) for rig in rigs if (rig, seed) not in finished(path)
    ]  # all placements with one seed first: what there is can be ranked
    if missing:
        todo = {rig: rigs[rig] for rig in dict.fromkeys(rig for rig, _ in missing)}
        training = simulate(todo, options.train, options.seed, "training frames")
        held_out = simulate(todo, options.validate, options.seed + 1, "held-out frames")
        for rig, seed in track(missing, description="training", console=Console(stderr=True)):
            detector = trained(rig, training, options.epochs, seed)
            append(path, {"placement": rig, "seed": seed, "ap": tested(detector, rig, held_out)})
    found = finished(path)
    return np.array([[found[rig, seed] for rig in rigs] for seed in range(options.seeds)])


def check_same(options, path):
    """Refuse to mix the trainings of different settings in one folder."""
    settings = {name: value for name, value in vars(options).items() if name not in ("out", "reduced")}
    if not path.exists():
        path.write_text(json.dumps(settings, indent=1), encoding="utf-8")
    earlier = json.loads(path.read_text(encoding="utf-8"))
    # A training depends on none of these.
    free = ("placements", "seeds", "num_frames", "metrics")
    if other := [name for name in settings if earlier.get(name) != settings[name] and name not in free]:
        told = ", ".join(f"{name} {earlier.get(name)} (now {settings[name]})" for name in other)
        raise SystemExit(f"{path.parent} holds trainings with {told}; choose another --out")


def page(judged, scores, options):
    """What came of it, in Markdown."""
    each = f"{options.seeds} training{'s' * (options.seeds > 1)} of each"
    text = (
        f"{len(judged.placements)} placements of {LIDARS} LiDARs ({LIDAR['channels']} rows, {LIDAR['columns']} columns "
        f"each), {each} on {options.train} frames in {options.epochs} epochs, average precision of cars on "
        f"{options.validate} held-out frames; metrics in {options.num_frames} other frames. Spearman's correlation and "
        "Kendall's tau-b with the mean of the trainings, 95 % intervals from drawing placements, trainings and worlds "
        "anew (where marked *, not worlds); p of a correlation as strong, of either sign, by chance; the lead is what "
        "Spearman's correlation has more than that of the mean mounting height.\n\n"
    )
    on_the_roof = [name for name in judged.placements if name.startswith("roof")]
    for words, names in (("All placements", judged.placements), ("Placements on the roof", on_the_roof)):
        if len(names) >= LEAST:
            text += f"## {words}\n\n{ranks(judged.select(names), scores.select(names))}\n"
    text += f"## Average precision\n\n| placement | LiDARs at x, y, z (m) | {' | '.join(judged.raters)} |\n"
    text += "|---|---|" + "---:|" * len(judged.raters) + "\n"
    rigs = placements(len(judged.placements), options.seed)
    for name, column in zip(judged.placements, judged.values.T, strict=True):
        places = "; ".join(
            f"{one.mount.x_m:.2f}, {one.mount.y_m:.2f}, {one.mount.z_m:.2f}" for one in rigs[name].sensors
        )
        text += f"| {name} | {places} | {' | '.join(f'{ap:.3f}' for ap in column)} |\n"
    return text


def ranks(judged, rankings):
    """The table of some placements, and what it is worth."""
    found = correlate_rankings(rankings, judged, resample_placements=True)
    (height,) = (one for one in rankings if one.name == "mean mounting height")
    ceiling = (
        f"{judged.inter_rater_correlation:.2f}"
        if len(judged.raters) > 1
        else "an unknown amount, for there is one of each,"
    )
    text = (
        f"The trainings agree with each other by {ceiling} on {len(judged.placements)} placements, whose "
        f"average precision is {judged.mean.min():.3f} to {judged.mean.max():.3f}. Of {found.metric_count} metrics the "
        f"best is `{found.best_metric}`, p = {found.best_p_value:.2g} corrected for the choice of "
        f"the best; in one of twenty cases, chance alone gives the best more than {found.chance_threshold:.2f}.\n\n"
        "| metric | Spearman | tau-b | p | lead |\n|---|---:|---:|---:|---:|\n"
    )
    order = sorted(
        zip(found.correlations, rankings, strict=True), key=lambda pair: -np.nan_to_num(pair[0].spearman.value)
    )
    leads = []
    for row, one in order:
        if np.isnan(row.spearman.value):
            continue
        above = compare_correlations(one, height, judged, resample_placements=True)
        leads += [one.name] if above.low > 0 else []
        name = f"{row.metric}{'' if row.resamples_scenes else ' *'}"
        text += f"| {name} | {row.spearman.text} | {row.kendall.text} | {row.p_value:.2g} | {above.text} |\n"
    ahead = ", ".join(f"`{name}`" for name in leads) or "No metric"
    return f"{text}\n{ahead}: ahead of the mean mounting height with an interval above 0.\n"


def main():
    """Train, measure, rank."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--placements", type=int, default=32)
    parser.add_argument("--seeds", type=int, default=4, help="trainings of each placement")
    parser.add_argument("--train", type=int, default=192, help="frames to train on")
    parser.add_argument("--validate", type=int, default=96, help="held-out frames, 4 from a drive")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--num-frames", type=int, default=96, help="steps that the metrics are measured in")
    parser.add_argument("--metrics", default="all", help="metrics of others, as in `k_cover,point_density`")
    parser.add_argument("--seed", type=int, default=0, help="of the placements and of the traffic")
    parser.add_argument("--reduced", action="store_true", help=f"no more than a trial: {REDUCED}")
    parser.add_argument("--out", type=Path, default=Path("out/placement_benchmark"))
    options = parser.parse_args()
    if options.reduced:
        vars(options).update(REDUCED)
    options.out.mkdir(parents=True, exist_ok=True)
    check_same(options, options.out / "settings.json")
    rigs = placements(options.placements, options.seed)
    values = train_all(rigs, options, options.out / "trainings.jsonl")
    judges = tuple(f"seed {seed}" for seed in range(options.seeds))
    judged = PlacementRatings("average precision", tuple(rigs), judges, values)
    scores = score_placements(
        rigs,
        "urban",
        region=Region("seen by the detector", X_M, Y_M),
        metrics=parse_metric_names(options.metrics),
        num_frames=options.num_frames,
        seed=options.seed + 2,
        frame_interval_s=WORLD_S,
        progress=True,
    )
    text = page(judged, scores, options)
    (options.out / "placement_benchmark.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
