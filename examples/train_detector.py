"""Train a 3D detector on two rigs and ask whether what it misses was visible: `python examples/train_detector.py`.

A PointPillars-like encoder (Lang et al. 2019) with a CenterPoint-like head (Yin et al. 2021) learns to find cars in
simulated city traffic, once with each rig, from the same instants. Every epoch logs average precision, coverage by
region and recall by visibility, side by side. At the end: a table, a figure, and how strongly visibility and recall
agree. With `--labels 3` it learns from three seeds each with all cars, and with those only that the rig can show, and
says what that changes in average precision by visibility.

Needs `pip install 'torchcover[lightning,tensorboard]'`; uses a GPU if there is one.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import lightning
import matplotlib

matplotlib.use("Agg")  # before pyplot: no display is needed
import matplotlib.pyplot as plt
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.profilers import SimpleProfiler
from rich.console import Console
from rich.progress import track
from rich.table import Table
from torch import nn
from torch.nn import functional
from torch.utils.data import DataLoader

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.data import Augmentation, SimulatedFrames, VisibleBoxes, collate_frames
from torchcover.detection import RecallByVisibility, match_detections, measure_box_visibility
from torchcover.report import format_number
from torchcover.simulation import PaperReference, SurfaceReference
from torchcover.training import CoverageCallback

RIGS = ("front_roof_128", "front_roof_32")
X_M, Y_M, Z_M = (0.0, 51.2), (-25.6, 25.6), (-1.0, 3.0)
PILLAR_M, CELL_M = 0.4, 0.8
PILLARS, CELLS = 128, 64
# What the network is fed: one point in each such cube.
VOXEL_M = 0.1
REGIONS = (Region("0-25m", (0.0, 25.6), (-12.8, 12.8)), Region("0-51m", X_M, Y_M))
# A car that the rig hardly touched teaches nothing; in the evaluation it counts.
MIN_HITS = 3
SCORES = tuple(np.linspace(0.05, 0.95, 46).round(3).tolist())
# The one of SCORES at which recall is shown.
OPERATING_SCORE = 0.31
MATCH_M = 2.0
# Of the labels that are compared: a car of which the rig shows less is left out of the ground truth.
LEAST_VISIBLE = 0.2
# Two-sided 95 % of Student's t, by the number of seeds.
STUDENT_T = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78, 6: 2.57, 7: 2.45, 8: 2.36}


# Data.


def in_region(boxes, categories=("car",)):
    """The cars whose centre lies in the region; `categories` is what they are called."""
    x, y, _ = boxes.center_m.T
    inside = (x >= X_M[0]) & (x < X_M[1]) & (y >= Y_M[0]) & (y < Y_M[1])
    return boxes.select(inside).select_categories(*categories)


def thinned(cloud):
    """The points of the region, one a voxel."""
    x, y, z = cloud.T
    cloud = cloud[(x >= X_M[0]) & (x < X_M[1]) & (y >= Y_M[0]) & (y < Y_M[1]) & (z >= Z_M[0]) & (z < Z_M[1])]
    _, first = np.unique(np.floor(cloud.numpy() / VOXEL_M), axis=0, return_index=True)
    return cloud[torch.from_numpy(np.sort(first))]


def simulate(steps, seed, reference, name, keep_clouds):
    """Frames with both rigs, 4 from each drive of a minute; `network RIG` is what the detector is fed."""
    rigs = {rig: rig for rig in RIGS}
    frames = SimulatedFrames(
        "urban", rigs=rigs, num_frames=steps, seed=seed, frame_interval_s=15.0, reference_sensor=reference, boxes=True
    )
    kept = []
    for index in track(range(steps), description=f"simulating {name}"):
        frame = frames[index]
        fed = {f"network {rig}": thinned(frame.get_measured_points(rig)) for rig in frame.clouds}
        clouds = {**frame.clouds, **fed} if keep_clouds else fed
        kept.append(replace(frame, clouds=clouds, boxes=in_region(frame.boxes)))
    return kept


# The detector.


class Pillars(nn.Module):
    """Points to a picture from above: the largest of each feature over the points of a pillar."""

    def __init__(self, channels):
        super().__init__()
        self.encode = nn.Sequential(nn.Linear(7, channels, bias=False), nn.BatchNorm1d(channels), nn.ReLU())
        self.channels = channels

    def forward(self, clouds):
        """Lists of (N, 3) to (B, C, y, x)."""
        numbers = [torch.full((len(cloud),), k, device=cloud.device) for k, cloud in enumerate(clouds)]
        points, frame = torch.cat(clouds), torch.cat(numbers)
        column = ((points[:, 0] - X_M[0]) / PILLAR_M).floor().long()
        row = ((points[:, 1] - Y_M[0]) / PILLAR_M).floor().long()
        inside = (column >= 0) & (column < PILLARS) & (row >= 0) & (row < PILLARS)
        points, frame, column, row = points[inside], frame[inside], column[inside], row[inside]
        pillar = (frame * PILLARS + row) * PILLARS + column
        count = torch.bincount(pillar, minlength=len(clouds) * PILLARS**2).clamp(min=1)
        mean = points.new_zeros(len(count), 3).index_add(0, pillar, points) / count[:, None]
        middle = torch.stack([column * PILLAR_M + X_M[0], row * PILLAR_M + Y_M[0]], dim=1) + PILLAR_M / 2
        features = torch.cat(
            [points - mean[pillar], points[:, :2] - middle, points[:, 2:], count[pillar, None].float().log()], dim=1
        )
        encoded = self.encode(features)
        picture = encoded.new_zeros(len(count), self.channels)
        picture = picture.scatter_reduce(0, pillar[:, None].expand_as(encoded), encoded, "amax")
        return picture.view(len(clouds), PILLARS, PILLARS, self.channels).permute(0, 3, 1, 2)


def block(inputs, outputs, stride=1):
    """Convolution, normalisation, ReLU."""
    layer = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(layer, nn.BatchNorm2d(outputs), nn.ReLU())


class Detector(nn.Module):
    """Heat of a centre, and of the box there: offset x, y, z, log of length, width, height, sine and cosine of yaw."""

    def __init__(self):
        super().__init__()
        self.pillars = Pillars(32)
        self.fine = nn.Sequential(block(32, 48, 2), block(48, 48), block(48, 48))
        self.coarse = nn.Sequential(block(48, 64, 2), block(64, 64), block(64, 64), nn.Upsample(scale_factor=2))
        self.head = nn.Sequential(block(112, 64), nn.Conv2d(64, 9, 1))
        nn.init.constant_(self.head[-1].bias[0], -4.0)

    def forward(self, clouds):
        """Lists of (N, 3) to heat (B, y, x) and boxes (B, 8, y, x)."""
        fine = self.fine(self.pillars(clouds))
        answer = self.head(torch.cat([fine, self.coarse(fine)], dim=1))
        return answer[:, 0], answer[:, 1:]


def encode(rows):
    """Of the objects in the region: x and y in cells, row and column of the cell, and (8, N) the box to be answered."""
    x, y = (rows[:, 0] - X_M[0]) / CELL_M, (rows[:, 1] - Y_M[0]) / CELL_M
    row, column = y.long(), x.long()
    inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    x, y, row, column, rows = (values[inside] for values in (x, y, row, column, rows))
    turn = (rows[:, 6].sin(), rows[:, 6].cos())
    wanted = torch.stack([x - column - 0.5, y - row - 0.5, rows[:, 2], *rows[:, 3:6].log().T, *turn])
    return x, y, row, column, wanted


def loss_of(heat, boxes, truth):
    """Focal loss of the heat (Zhou et al. 2019) plus the absolute error of the boxes, both per object."""
    centres = torch.arange(CELLS, device=heat.device) + 0.5
    total, objects = heat.new_zeros(()), sum(map(len, truth))
    for frame_heat, frame_boxes, objects_there in zip(heat, boxes, truth, strict=True):
        x, y, row, column, wanted = encode(objects_there)
        apart = (centres[None, :, None] - y[:, None, None]) ** 2 + (centres[None, None] - x[:, None, None]) ** 2
        near = torch.cat([torch.exp(-apart / 2), apart.new_zeros(1, CELLS, CELLS)]).amax(dim=0)
        positive = torch.zeros_like(near, dtype=torch.bool)
        positive[row, column] = True
        p = frame_heat.sigmoid()
        total = total - ((1 - p) ** 2 * functional.logsigmoid(frame_heat))[positive].sum()
        total = total - (p**2 * (1 - near) ** 4 * functional.logsigmoid(-frame_heat))[~positive].sum()
        total = total + (frame_boxes[:, row, column] - wanted).abs().sum() / 2
    return total / max(objects, 1)


def decode(heat, boxes, most=100):
    """(N, 7) rows and (N,) scores of one frame: the peaks of the heat."""
    score = heat.sigmoid()
    peak = score == functional.max_pool2d(score[None], 3, 1, 1)[0]
    score, place = (score * peak).flatten().topk(most)
    score, place = score[score >= SCORES[0]], place[score >= SCORES[0]]
    dx, dy, z, *size, sine, cosine = boxes.flatten(1)[:, place]
    x = X_M[0] + (place % CELLS + 0.5 + dx) * CELL_M
    y = Y_M[0] + (place // CELLS + 0.5 + dy) * CELL_M
    return torch.stack([x, y, z, *(s.clamp(-2, 3).exp() for s in size), torch.atan2(sine, cosine)], dim=1), score


def average_precision(counts, at=None):
    """Mean over 101 recalls of the precision there, as in nuScenes but without its cut-offs; NaN without objects.

    Of a bin of visibility, by its number: over the recalls of its objects, with the precision of all detections.
    """
    curve, of_bin = counts.compute_overall(), counts.compute_curve("visibility").recall
    recalls = curve.recall.value[:, 0] if at is None else of_bin.value[:, at]
    columns = (recalls, curve.precision.value[:, 0], curve.precision.trials[:, 0])
    recall, precision, detections = (column.cpu().numpy() for column in columns)
    used = detections > 0
    if not counts.objects.any() or np.isnan(recall).all():
        return math.nan
    if not used.any():
        return 0.0
    recall, precision = recall[used][::-1], precision[used][::-1]  # recall ascends
    recall, precision = np.append(0.0, recall), np.append(precision[0], precision)
    return float(np.interp(np.linspace(0, 1, 101), recall, precision, right=0).mean())


class Training(lightning.LightningModule):
    """One rig's detector, its losses and its logs."""

    def __init__(self, rig, visibility, steps, seed, least_hits=MIN_HITS):
        super().__init__()
        self.rig = rig
        self.detector = Detector()
        self.recall = RecallByVisibility(threshold=MATCH_M, score_thresholds=SCORES)
        self.visibility = visibility
        self.steps = steps
        self.least_hits = least_hits
        self.augment = Augmentation(max_yaw_rad=math.radians(15.0), seed=seed)
        self.objects = []

    def training_step(self, batch, _):
        """The loss of augmented frames."""
        frames = [self.augment(frame, self.current_epoch) for frame in batch.frames]
        heat, boxes = self.detector([frame.clouds[f"network {self.rig}"] for frame in frames])
        truth = [frame.boxes.select(frame.boxes.points_in_box[self.rig] >= self.least_hits).rows for frame in frames]
        loss = loss_of(heat, boxes, truth)
        self.log("loss", loss, batch_size=len(batch), prog_bar=True)
        return loss

    def on_validation_epoch_start(self):
        """Keep the objects of the last epoch only."""
        self.objects = []

    def validation_step(self, batch, _):
        """Count what was found, of what was visible."""
        heat, boxes = self.detector(batch.get_clouds(f"network {self.rig}"))
        for frame, frame_heat, frame_boxes in zip(batch.frames, heat, boxes, strict=True):
            rows, scores = decode(frame_heat, frame_boxes)
            seen = self.visibility[frame.index]
            self.recall.update(rows, frame.boxes, seen, scores)
            chosen = match_detections(rows, scores, frame.boxes.rows, "distance", MATCH_M)
            found = torch.zeros(len(frame.boxes))
            found[chosen[chosen >= 0]] = scores.cpu()[chosen >= 0]
            columns = [frame.boxes.center_m[:, 0], frame.boxes.center_m[:, 1], seen.share.cpu(), found]
            world = torch.full((len(found),), float(frame.index // 4))
            self.objects.append(torch.stack([world, *(column.cpu().float() for column in columns)], dim=1))

    def on_validation_epoch_end(self):
        """Log average precision and recall beside the coverage."""
        self.counts = self.recall.compute()
        row = SCORES.index(OPERATING_SCORE)
        curve = self.counts.compute_curve("visibility")
        scalars = {
            f"val/recall/visibility {name}": float(r)
            for name, r in zip(curve.bins, curve.recall.value[row], strict=True)
        }
        self.log_dict({"val/AP": average_precision(self.counts), **scalars})
        self.recall.reset()

    def configure_optimizers(self):
        """Adam with one cycle of the learning rate."""
        optimizer = torch.optim.AdamW(self.parameters(), lr=1e-3, weight_decay=0.01)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=3e-3, total_steps=self.steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def coverage_metric(*, has_area_weights):
    """The metric of the region; with the defaults as many blocks as drives, which know nothing of each other."""
    band_frame = "ground" if has_area_weights else "vehicle"
    grid = BevGrid(x_m=X_M, y_m=Y_M, cell_m=1.6, heights={"body": (0.3, 2.0)}, band_frame=band_frame)
    return CoverageMetric(grid, max_radius_m=grid.diagonal_m, num_blocks=16, has_area_weights=has_area_weights)


def train(rig, training_frames, validation_frames, metric, options, console, **of_training):
    """Train one rig's detector, with the coverage beside it if there is a metric; its module, and the coverage."""
    lightning.seed_everything(options.seed, verbose=False)
    loaders = [
        DataLoader(training_frames, batch_size=8, shuffle=True, drop_last=True, collate_fn=collate_frames),
        DataLoader(validation_frames, batch_size=8, collate_fn=collate_frames),
    ]
    coverage = metric and CoverageCallback(metric, regions=REGIONS, rig_name=rig, has_fixed_frames=True)
    visibility = {
        f.index: measure_box_visibility(f.clouds[rig], f.reference, f.boxes, reference_weights=f.reference_weights)
        for f in validation_frames
    }
    module = Training(rig, visibility, steps=options.epochs * len(loaders[0]), seed=options.seed, **of_training)
    profiler = SimpleProfiler(dirpath=options.out, filename=f"profile-{rig}")
    trainer = lightning.Trainer(
        devices=1,
        max_epochs=options.epochs,
        logger=TensorBoardLogger(options.out, name=rig, version=""),
        callbacks=[coverage] if coverage else [],
        profiler=profiler,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        enable_checkpointing=False,
        enable_model_summary=False,
    )
    trainer.fit(module, *loaders)
    if not coverage:
        return module, None
    seconds = {action: sum(durations) for action, durations in profiler.recorded_durations.items()}
    measuring = sum(time for action, time in seconds.items() if "CoverageCallback" in action)
    epochs = seconds["run_training_epoch"]
    console.print(f"{rig}: coverage took {measuring:.1f} s of {epochs:.0f} s of epochs, {measuring / epochs:.1%}")
    return module, coverage.coverage


def compare_labels(options, console):
    """Train on all cars, and on those only that the rig can show, from several seeds; AP by visibility of both."""
    rig, surface = RIGS[-1], SurfaceReference(((X_M, Y_M),), max_range_m=65.0, points_per_object=64)
    frames = {
        name: simulate(steps, seed, surface, f"{name} frames", keep_clouds=True)
        for name, steps, seed in (("training", options.train, 0), ("validation", options.validate, 1))
    }
    visible = list(VisibleBoxes(frames["training"], LEAST_VISIBLE, rig_name=rig))
    cars = sum(len(frame.boxes) for frame in visible)
    left_out = sum(frame.counts["targets_omitted"] for frame in visible)
    console.print(f"{cars} cars are visible, {left_out} are left out: below {LEAST_VISIBLE:.0%}, or unknown")
    found = {"all cars": [], "visible cars": []}
    for seed in range(options.labels):
        seeded = argparse.Namespace(**{**vars(options), "seed": seed})
        for name, labelled in zip(found, (frames["training"], visible), strict=True):
            module, _ = train(rig, labelled, frames["validation"], None, seeded, console, least_hits=0)
            bins = module.counts.compute_curve("visibility").bins
            of_bins = [average_precision(module.counts, at) for at in range(len(bins))]
            found[name].append([average_precision(module.counts), *of_bins])
    report_labels(np.array(list(found.values())), ["all", *bins], module.counts, console)


# What came of it.


def report_labels(values, names, counts, console):
    """Print AP with all labels and with the visible ones, (2, seeds, bins), and what of the change is beyond chance."""
    seeds = values.shape[1]
    table = Table("visibility", "cars", "AP, all cars", "AP, visible cars", "change, 95 % over seeds", "")
    cars = [counts.objects.sum(), *counts.objects.sum(dim=1)]
    for at, (name, number) in enumerate(zip(names, map(int, cars), strict=True)):
        if not number:
            continue
        mean, change = values[:, :, at].mean(axis=1), values[1, :, at] - values[0, :, at]
        half = STUDENT_T[seeds] * change.std(ddof=1) / math.sqrt(seeds)
        told = "more than chance" if abs(change.mean()) > half else "nothing can be said"
        numbers = (f"{mean[0]:.3f}", f"{mean[1]:.3f}", f"{change.mean():+.3f} ± {half:.3f}")
        table.add_row(name, str(number), *numbers, told)
    console.print(table)


def ranks(values):
    """Ranks, ties sharing their mean."""
    _, group, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[group]


def spearman(a, b):
    """Rank correlation; NaN where one of the two does not vary."""
    varies = min(len(np.unique(a)), len(np.unique(b))) > 1
    return float(np.corrcoef(ranks(a), ranks(b))[0, 1]) if varies else math.nan


def over_drives(objects, statistic, draws=1000):
    """A statistic of the objects and its 95 % interval, from drawing whole drives again and again; NaN if unknown."""
    worlds = [objects[objects[:, 0] == world] for world in np.unique(objects[:, 0])]
    generator = np.random.default_rng(0)
    values = [
        statistic(np.concatenate([worlds[k] for k in generator.integers(len(worlds), size=len(worlds))]))
        for _ in range(draws if worlds else 0)
    ]
    known = np.array([value for value in values if not math.isnan(value)])
    return statistic(objects), *(np.quantile(known, [0.025, 0.975]) if len(known) else (math.nan, math.nan))


def agreement(objects):
    """Rank correlation of an object's visibility with the score at which it was found, 0 if it was not."""
    return spearman(objects[:, 3], objects[:, 4])


def cell_agreement(objects, side_m=6.4, least=5):
    """Rank correlation over cells of the plane: the mean visibility of their objects with their recall."""
    column, row = (objects[:, 1] // side_m).astype(int), ((objects[:, 2] - Y_M[0]) // side_m).astype(int)
    _, cell = np.unique(row * 1000 + column, return_inverse=True)
    count = np.bincount(cell)
    visible, found = (np.bincount(cell, weights=w) / count for w in (objects[:, 3], objects[:, 4] >= OPERATING_SCORE))
    return spearman(visible[count >= least], found[count >= least])


def report(results, console):
    """Print the table of both rigs, and how strongly visibility and recall agree."""
    table = Table("rig", "AP", *(f"seen within 0.4 m, {region.name} (%)" for region in REGIONS), "recall", "precision")
    row = SCORES.index(OPERATING_SCORE)
    for rig, (module, coverage) in results.items():
        curve = module.counts.compute_overall()
        numbers = [line.numbers["detection_0.4m"] for line in coverage.summary(REGIONS)]
        seen = map(format_number, numbers)
        shares = [f"{ratio.value[row, 0]:.3f}" for ratio in (curve.recall, curve.precision)]
        table.add_row(rig, f"{average_precision(module.counts):.3f}", *seen, *shares)
    console.print(table)
    for rig, (module, _) in results.items():
        objects = torch.cat(module.objects).double().numpy()
        known = np.isfinite(objects[:, 3])
        console.print(f"{rig}: {known.sum()} of {len(known)} cars have a known visibility")
        objects = objects[known]
        distance = np.hypot(objects[:, 1], objects[:, 2])
        parts = {"all": distance >= 0, "0-25 m": distance < 25.0, "over 25 m": distance >= 25.0}
        for name, part in parts.items():
            value, low, high = over_drives(objects[part], agreement)
            console.print(f"{rig}, {name}: Spearman {value:.2f} ({low:.2f} to {high:.2f}), {part.sum()} cars")
        value, low, high = over_drives(objects, cell_agreement, draws=300)
        console.print(f"{rig}, cells of 6.4 m: Spearman {value:.2f} ({low:.2f} to {high:.2f})")


def draw(results, path):
    """Recall over visibility and over distance; AP and coverage."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(14.0, 4.4), layout="constrained")
    row = SCORES.index(OPERATING_SCORE)
    for ax, axis in ((left, "visibility"), (middle, "distance")):
        curves = [module.counts.compute_curve(axis) for module, _ in results.values()]
        cars = torch.stack([curve.recall.trials[row] for curve in curves], dim=1)
        seen = [k for k in range(len(cars)) if cars[k].any()]
        on_the_axis = sum(curves[0].bins[k][0].isdigit() for k in seen)  # hidden cars have a point, but no place on it
        for shift, rig, curve in zip((-0.05, 0.05), results, curves, strict=True):
            value, low, high = (
                t[row, seen].cpu().numpy() for t in (curve.recall.value, curve.recall.low, curve.recall.high)
            )
            x, error = np.arange(len(seen)) + shift, np.abs(np.stack([value - low, high - value]))
            marks = ax.errorbar(x, value, error, fmt="o", capsize=3, label=rig)
            ax.plot(x[:on_the_axis], value[:on_the_axis], color=marks[0].get_color())
        ax.set_xticks(range(len(seen)), ["\n".join(map(str, [curves[0].bins[k], *cars[k].tolist()])) for k in seen])
        ax.set(xlabel=f"{axis} of the car; below, cars for each rig, in order", ylabel="recall", ylim=(0, 1.03))
    for shift, (rig, (module, coverage)) in zip((-0.2, 0.2), results.items(), strict=True):
        seen = [line.numbers["detection_0.4m"] for line in coverage.summary(REGIONS)]
        bars = [average_precision(module.counts), *(number.value for number in seen)]
        errors = [math.nan, *(number.error for number in seen)]
        right.bar(np.arange(len(bars)) + shift, bars, width=0.38, yerr=errors, capsize=3, label=rig)
    right.set_xticks(range(3), ["AP", *(f"seen within\n0.4 m, {region.name}" for region in REGIONS)])
    right.set(ylim=(0, 1))
    right.legend()
    left.set_title(f"recall at score {OPERATING_SCORE}, 95 % Wilson intervals")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    """Simulate, train both detectors, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=192, help="frames to train on")
    parser.add_argument("--validate", type=int, default=64, help="frames to validate on, 4 from a drive")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--labels", type=int, choices=STUDENT_T, help="compare labels instead, from so many seeds")
    parser.add_argument("--out", type=Path, default=Path("out/train_detector"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    console = Console()
    if options.labels:
        compare_labels(options, console)
        return
    unused = PaperReference(rows=1, columns=1)
    surface = SurfaceReference(((X_M, Y_M),), max_range_m=65.0, points_per_object=64)
    training_frames = simulate(options.train, options.seed, unused, "training frames", keep_clouds=False)
    validation_frames = simulate(options.validate, options.seed + 1, surface, "validation frames", keep_clouds=True)
    results = {}
    for rig in RIGS:
        metric = coverage_metric(has_area_weights=True)
        results[rig] = train(rig, training_frames, validation_frames, metric, options, console)
    report(results, console)
    draw(results, options.out / "detector.png")
    console.print(f"Wrote {options.out / 'detector.png'} and event files for TensorBoard beside it")


if __name__ == "__main__":
    main()
