"""Train a 3D detector on two rigs and compare its misses with visibility: `python examples/train_detector.py`.

An encoder like PointPillars (Lang et al. 2019) with a head like CenterPoint (Yin et al. 2021) learns to detect cars in
simulated city traffic, once with each rig, from the same frames. Every epoch logs average precision, coverage by region
and recall by visibility. The results are a table, a figure, and the rank correlation of visibility and recall. With
`--labels 3`, it is trained with three seeds on all cars and on the cars that the rig can observe, and the example
prints the change of average precision by visibility.

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
# Region of the detector; 128 pillars and 64 cells of the output cover it.
X_M = (0.0, 51.2)
Y_M = (-25.6, 25.6)
Z_M = (-1.0, 3.0)
PILLAR_M = 0.4
CELL_M = 0.8
PILLARS = 128
CELLS = 64
# The network receives one point per voxel of this size.
VOXEL_M = 0.1
REGIONS = (Region("0-25m", (0.0, 25.6), (-12.8, 12.8)), Region("0-51m", X_M, Y_M))
# Cars with fewer sensor points are not used for training; the evaluation counts them.
MIN_POINTS = 3
SCORES = tuple(np.linspace(0.05, 0.95, 46).round(3).tolist())
# Element of SCORES at which recall is reported.
OPERATING_SCORE = 0.31
MATCH_M = 2.0
# With `--labels`, cars with a lower visibility are removed from the ground truth.
MIN_VISIBILITY = 0.2
# Two-sided 95 % quantile of Student's t by the number of seeds.
STUDENT_T = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78, 6: 2.57, 7: 2.45, 8: 2.36}


# Data


def select_cars_in_region(boxes, categories=("car",)):
    """Select the boxes of cars whose center lies in the region."""
    x, y, _ = boxes.center_m.T
    is_inside = (x >= X_M[0]) & (x < X_M[1]) & (y >= Y_M[0]) & (y < Y_M[1])
    return boxes.select(is_inside).select_categories(*categories)


def thin_cloud(cloud):
    """Keep one point per voxel, within the region."""
    x, y, z = cloud.T
    cloud = cloud[(x >= X_M[0]) & (x < X_M[1]) & (y >= Y_M[0]) & (y < Y_M[1]) & (z >= Z_M[0]) & (z < Z_M[1])]
    _, first_indices = np.unique(np.floor(cloud.numpy() / VOXEL_M), axis=0, return_index=True)
    return cloud[torch.from_numpy(np.sort(first_indices))]


def simulate(num_frames, seed, reference, name, keep_clouds):
    """Simulate frames with both rigs, four per drive of one minute; `network RIG` is the input of the detector."""
    rigs = {rig: rig for rig in RIGS}
    frames = SimulatedFrames(
        "urban",
        rigs=rigs,
        num_frames=num_frames,
        seed=seed,
        frame_interval_s=15.0,
        reference_sensor=reference,
        boxes=True,
    )
    prepared = []
    for index in track(range(num_frames), description=f"simulating {name}"):
        frame = frames[index]
        inputs = {f"network {rig}": thin_cloud(frame.get_measured_points(rig)) for rig in frame.clouds}
        clouds = {**frame.clouds, **inputs} if keep_clouds else inputs
        prepared.append(replace(frame, clouds=clouds, boxes=select_cars_in_region(frame.boxes)))
    return prepared


# Detector


class Pillars(nn.Module):
    """Encoder of points as a bird's-eye-view image: the maximum of each feature over the points of a pillar."""

    def __init__(self, channels):
        super().__init__()
        self.encode = nn.Sequential(nn.Linear(7, channels, bias=False), nn.BatchNorm1d(channels), nn.ReLU())
        self.channels = channels

    def forward(self, clouds):
        """Encode a list of B clouds (N, 3) as an image (B, C, y, x)."""
        frame_indices = [torch.full((len(cloud),), k, device=cloud.device) for k, cloud in enumerate(clouds)]
        points, frame = torch.cat(clouds), torch.cat(frame_indices)
        column = ((points[:, 0] - X_M[0]) / PILLAR_M).floor().long()
        row = ((points[:, 1] - Y_M[0]) / PILLAR_M).floor().long()
        is_inside = (column >= 0) & (column < PILLARS) & (row >= 0) & (row < PILLARS)
        points, frame, column, row = points[is_inside], frame[is_inside], column[is_inside], row[is_inside]
        pillar = (frame * PILLARS + row) * PILLARS + column
        count = torch.bincount(pillar, minlength=len(clouds) * PILLARS**2).clamp(min=1)
        mean = points.new_zeros(len(count), 3).index_add(0, pillar, points) / count[:, None]
        center = torch.stack([column * PILLAR_M + X_M[0], row * PILLAR_M + Y_M[0]], dim=1) + PILLAR_M / 2
        features = torch.cat(
            [points - mean[pillar], points[:, :2] - center, points[:, 2:], count[pillar, None].float().log()], dim=1
        )
        encoded = self.encode(features)
        image = encoded.new_zeros(len(count), self.channels)
        image = image.scatter_reduce(0, pillar[:, None].expand_as(encoded), encoded, "amax")
        return image.view(len(clouds), PILLARS, PILLARS, self.channels).permute(0, 3, 1, 2)


def build_block(inputs, outputs, stride=1):
    """Build a block of convolution, normalization and ReLU."""
    convolution = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU())


class Detector(nn.Module):
    """Network that predicts a heat map of centers and boxes: offset x, y, z, log of size, sine and cosine of yaw."""

    def __init__(self):
        super().__init__()
        self.pillars = Pillars(32)
        self.fine = nn.Sequential(build_block(32, 48, 2), build_block(48, 48), build_block(48, 48))
        self.coarse = nn.Sequential(
            build_block(48, 64, 2), build_block(64, 64), build_block(64, 64), nn.Upsample(scale_factor=2)
        )
        self.head = nn.Sequential(build_block(112, 64), nn.Conv2d(64, 9, 1))
        nn.init.constant_(self.head[-1].bias[0], -4.0)

    def forward(self, clouds):
        """Predict the heat map (B, y, x) and the boxes (B, 8, y, x) of a list of B clouds (N, 3)."""
        fine = self.fine(self.pillars(clouds))
        output = self.head(torch.cat([fine, self.coarse(fine)], dim=1))
        return output[:, 0], output[:, 1:]


def encode(rows):
    """Encode the objects in the region: x and y in cells, row and column of the cell, and target boxes (8, N)."""
    x, y = (rows[:, 0] - X_M[0]) / CELL_M, (rows[:, 1] - Y_M[0]) / CELL_M
    row, column = y.long(), x.long()
    is_inside = (column >= 0) & (column < CELLS) & (row >= 0) & (row < CELLS)
    x, y, row, column, rows = (values[is_inside] for values in (x, y, row, column, rows))
    heading = (rows[:, 6].sin(), rows[:, 6].cos())
    targets = torch.stack([x - column - 0.5, y - row - 0.5, rows[:, 2], *rows[:, 3:6].log().T, *heading])
    return x, y, row, column, targets


def compute_loss(heat, boxes, ground_truth):
    """Compute the focal loss of the heat (Zhou et al. 2019) plus the absolute error of the boxes, both per object."""
    centers = torch.arange(CELLS, device=heat.device) + 0.5
    total, object_count = heat.new_zeros(()), sum(len(rows) for rows in ground_truth)
    for frame_heat, frame_boxes, rows in zip(heat, boxes, ground_truth, strict=True):
        x, y, row, column, targets = encode(rows)
        squared_distance = (centers[None, :, None] - y[:, None, None]) ** 2 + (
            centers[None, None] - x[:, None, None]
        ) ** 2
        closeness = torch.cat([torch.exp(-squared_distance / 2), squared_distance.new_zeros(1, CELLS, CELLS)])
        target_heat = closeness.amax(dim=0)
        is_center = torch.zeros_like(target_heat, dtype=torch.bool)
        is_center[row, column] = True
        p = frame_heat.sigmoid()
        total = total - ((1 - p) ** 2 * functional.logsigmoid(frame_heat))[is_center].sum()
        total = total - (p**2 * (1 - target_heat) ** 4 * functional.logsigmoid(-frame_heat))[~is_center].sum()
        total = total + (frame_boxes[:, row, column] - targets).abs().sum() / 2
    return total / max(object_count, 1)


def decode(heat, boxes, max_count=100):
    """Decode the peaks of the heat map of one frame as (N, 7) rows and (N,) scores."""
    score = heat.sigmoid()
    peak = score == functional.max_pool2d(score[None], 3, 1, 1)[0]
    score, cell = (score * peak).flatten().topk(max_count)
    score, cell = score[score >= SCORES[0]], cell[score >= SCORES[0]]
    dx, dy, z, *size, sine, cosine = boxes.flatten(1)[:, cell]
    x = X_M[0] + (cell % CELLS + 0.5 + dx) * CELL_M
    y = Y_M[0] + (cell // CELLS + 0.5 + dy) * CELL_M
    return torch.stack(
        [x, y, z, *(log_size.clamp(-2, 3).exp() for log_size in size), torch.atan2(sine, cosine)], dim=1
    ), score


def compute_average_precision(counts, visibility_bin=None):
    """Compute the mean precision at 101 recalls, as in nuScenes but without its cut-offs; NaN without objects.

    With the index of a visibility bin: at the recalls of its objects, with the precision of all detections.
    """
    curve, bin_recall = counts.compute_overall(), counts.compute_curve("visibility").recall
    recalls = curve.recall.value[:, 0] if visibility_bin is None else bin_recall.value[:, visibility_bin]
    columns = (recalls, curve.precision.value[:, 0], curve.precision.trials[:, 0])
    recall, precision, detections = (column.cpu().numpy() for column in columns)
    has_detections = detections > 0
    if not counts.objects.any() or np.isnan(recall).all():
        return math.nan
    if not has_detections.any():
        return 0.0
    recall, precision = recall[has_detections][::-1], precision[has_detections][::-1]  # recall ascends
    recall, precision = np.append(0.0, recall), np.append(precision[0], precision)
    return float(np.interp(np.linspace(0, 1, 101), recall, precision, right=0).mean())


class Training(lightning.LightningModule):
    """Training of the detector of one rig, with its losses and logs."""

    def __init__(self, rig, visibility, num_steps, seed, min_points=MIN_POINTS):
        super().__init__()
        self.rig = rig
        self.detector = Detector()
        self.recall = RecallByVisibility(threshold=MATCH_M, score_thresholds=SCORES)
        self.visibility = visibility
        self.num_steps = num_steps
        self.min_points = min_points
        self.augment = Augmentation(max_yaw_rad=math.radians(15.0), seed=seed)
        self.objects = []

    def training_step(self, batch, _):
        """Compute the loss of augmented frames."""
        frames = [self.augment(frame, self.current_epoch) for frame in batch.frames]
        heat, boxes = self.detector([frame.clouds[f"network {self.rig}"] for frame in frames])
        ground_truth = []
        for frame in frames:
            has_points = frame.boxes.points_in_box[self.rig] >= self.min_points
            ground_truth.append(frame.boxes.select(has_points).rows)
        loss = compute_loss(heat, boxes, ground_truth)
        self.log("loss", loss, batch_size=len(batch), prog_bar=True)
        return loss

    def on_validation_epoch_start(self):
        """Delete the objects of the previous epoch."""
        self.objects = []

    def validation_step(self, batch, _):
        """Count detected objects by visibility."""
        heat, boxes = self.detector(batch.get_clouds(f"network {self.rig}"))
        for frame, frame_heat, frame_boxes in zip(batch.frames, heat, boxes, strict=True):
            rows, scores = decode(frame_heat, frame_boxes)
            visibility = self.visibility[frame.index]
            self.recall.update(rows, frame.boxes, visibility, scores)
            matches = match_detections(rows, scores, frame.boxes.rows, "distance", MATCH_M)
            object_scores = torch.zeros(len(frame.boxes))
            object_scores[matches[matches >= 0]] = scores.cpu()[matches >= 0]
            columns = [frame.boxes.center_m[:, 0], frame.boxes.center_m[:, 1], visibility.share.cpu(), object_scores]
            drive = torch.full((len(object_scores),), float(frame.index // 4))
            self.objects.append(torch.stack([drive, *(column.cpu().float() for column in columns)], dim=1))

    def on_validation_epoch_end(self):
        """Log average precision and recall."""
        self.counts = self.recall.compute()
        row = SCORES.index(OPERATING_SCORE)
        curve = self.counts.compute_curve("visibility")
        scalars = {
            f"val/recall/visibility {name}": float(recall)
            for name, recall in zip(curve.bins, curve.recall.value[row], strict=True)
        }
        self.log_dict({"val/AP": compute_average_precision(self.counts), **scalars})
        self.recall.reset()

    def configure_optimizers(self):
        """Create AdamW with one cycle of the learning rate."""
        optimizer = torch.optim.AdamW(self.parameters(), lr=1e-3, weight_decay=0.01)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, max_lr=3e-3, total_steps=self.num_steps)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}


def build_coverage_metric(*, has_area_weights):
    """Build the metric of the region, with one block per drive for the default number of frames."""
    band_frame = "ground" if has_area_weights else "vehicle"
    grid = BevGrid(x_m=X_M, y_m=Y_M, cell_m=1.6, heights={"body": (0.3, 2.0)}, band_frame=band_frame)
    return CoverageMetric(grid, max_radius_m=grid.diagonal_m, num_blocks=16, has_area_weights=has_area_weights)


def train(rig, training_frames, validation_frames, metric, options, console, **training_arguments):
    """Train the detector of one rig and log its coverage if there is a metric; returns the module and the coverage."""
    lightning.seed_everything(options.seed, verbose=False)
    loaders = [
        DataLoader(training_frames, batch_size=8, shuffle=True, drop_last=True, collate_fn=collate_frames),
        DataLoader(validation_frames, batch_size=8, collate_fn=collate_frames),
    ]
    coverage = metric and CoverageCallback(metric, regions=REGIONS, rig_name=rig, has_fixed_frames=True)
    visibility = {
        frame.index: measure_box_visibility(
            frame.clouds[rig], frame.reference, frame.boxes, reference_weights=frame.reference_weights
        )
        for frame in validation_frames
    }
    module = Training(
        rig, visibility, num_steps=options.epochs * len(loaders[0]), seed=options.seed, **training_arguments
    )
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
    durations_s = {action: sum(durations) for action, durations in profiler.recorded_durations.items()}
    coverage_s = sum(duration_s for action, duration_s in durations_s.items() if "CoverageCallback" in action)
    epochs_s = durations_s["run_training_epoch"]
    console.print(f"{rig}: coverage took {coverage_s:.1f} s of {epochs_s:.0f} s of epochs, {coverage_s / epochs_s:.1%}")
    return module, coverage.coverage


def compare_labels(options, console):
    """Train with several seeds on all cars and on visible cars, and print the AP of both by visibility."""
    rig, surface = RIGS[-1], SurfaceReference(((X_M, Y_M),), max_range_m=65.0, points_per_object=64)
    frames = {
        name: simulate(num_frames, seed, surface, f"{name} frames", keep_clouds=True)
        for name, num_frames, seed in (("training", options.train, 0), ("validation", options.validate, 1))
    }
    visible = list(VisibleBoxes(frames["training"], MIN_VISIBILITY, rig_name=rig))
    cars = sum(len(frame.boxes) for frame in visible)
    omitted = sum(frame.counts["targets_omitted"] for frame in visible)
    console.print(f"{cars} cars are visible, {omitted} are omitted: below {MIN_VISIBILITY:.0%}, or unknown")
    precisions = {"all cars": [], "visible cars": []}
    for seed in range(options.labels):
        seeded = argparse.Namespace(**{**vars(options), "seed": seed})
        for name, labeled_frames in zip(precisions, (frames["training"], visible), strict=True):
            module, _ = train(rig, labeled_frames, frames["validation"], None, seeded, console, min_points=0)
            bins = module.counts.compute_curve("visibility").bins
            bin_precisions = [compute_average_precision(module.counts, index) for index in range(len(bins))]
            precisions[name].append([compute_average_precision(module.counts), *bin_precisions])
    print_label_comparison(np.array(list(precisions.values())), ["all", *bins], module.counts, console)


# Results


def print_label_comparison(values, names, counts, console):
    """Print the AP (2, seeds, bins) with all and with visible labels, and whether the change is significant."""
    seeds = values.shape[1]
    table = Table("visibility", "cars", "AP, all cars", "AP, visible cars", "change, 95 % over seeds", "")
    cars = [counts.objects.sum(), *counts.objects.sum(dim=1)]
    for index, (name, count) in enumerate(zip(names, map(int, cars), strict=True)):
        if not count:
            continue
        mean, change = values[:, :, index].mean(axis=1), values[1, :, index] - values[0, :, index]
        half_width = STUDENT_T[seeds] * change.std(ddof=1) / math.sqrt(seeds)
        verdict = "significant" if abs(change.mean()) > half_width else "not significant"
        numbers = (f"{mean[0]:.3f}", f"{mean[1]:.3f}", f"{change.mean():+.3f} ± {half_width:.3f}")
        table.add_row(name, str(count), *numbers, verdict)
    console.print(table)


def compute_ranks(values):
    """Compute ranks; ties have their mean rank."""
    _, group, count = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(count) - (count - 1) / 2)[group]


def compute_spearman(first, second):
    """Compute Spearman's rank correlation; NaN if one of the two is constant."""
    is_varying = min(len(np.unique(first)), len(np.unique(second))) > 1
    return float(np.corrcoef(compute_ranks(first), compute_ranks(second))[0, 1]) if is_varying else math.nan


def bootstrap_over_drives(objects, statistic, num_samples=1000):
    """Compute a statistic of the objects and its 95 % bootstrap interval over whole drives; NaN if unknown."""
    drives = [objects[objects[:, 0] == drive] for drive in np.unique(objects[:, 0])]
    generator = np.random.default_rng(0)
    values = []
    for _ in range(num_samples if drives else 0):
        sample = generator.integers(len(drives), size=len(drives))
        values.append(statistic(np.concatenate([drives[index] for index in sample])))
    finite = np.array([value for value in values if not math.isnan(value)])
    return statistic(objects), *(np.quantile(finite, [0.025, 0.975]) if len(finite) else (math.nan, math.nan))


def correlate_visibility_with_score(objects):
    """Correlate the visibility of an object with the score of its detection, 0 if it was missed."""
    return compute_spearman(objects[:, 3], objects[:, 4])


def correlate_visibility_with_recall(objects, cell_m=6.4, min_cars=5):
    """Correlate the mean visibility with the recall over cells in bird's-eye view that have enough cars."""
    column, row = (objects[:, 1] // cell_m).astype(int), ((objects[:, 2] - Y_M[0]) // cell_m).astype(int)
    _, cell = np.unique(row * 1000 + column, return_inverse=True)
    count = np.bincount(cell)
    visibility = np.bincount(cell, weights=objects[:, 3]) / count
    recall = np.bincount(cell, weights=objects[:, 4] >= OPERATING_SCORE) / count
    return compute_spearman(visibility[count >= min_cars], recall[count >= min_cars])


def print_report(results, console):
    """Print the table of both rigs, and the rank correlations of visibility and detections."""
    table = Table(
        "rig", "AP", *(f"detected within 0.4 m, {region.name} (%)" for region in REGIONS), "recall", "precision"
    )
    row = SCORES.index(OPERATING_SCORE)
    for rig, (module, coverage) in results.items():
        curve = module.counts.compute_overall()
        numbers = [line.numbers["detection_0.4m"] for line in coverage.summary(REGIONS)]
        rates = map(format_number, numbers)
        shares = [f"{ratio.value[row, 0]:.3f}" for ratio in (curve.recall, curve.precision)]
        table.add_row(rig, f"{compute_average_precision(module.counts):.3f}", *rates, *shares)
    console.print(table)
    for rig, (module, _) in results.items():
        objects = torch.cat(module.objects).double().numpy()
        has_visibility = np.isfinite(objects[:, 3])
        console.print(f"{rig}: the visibility of {has_visibility.sum()} of {len(has_visibility)} cars is known")
        objects = objects[has_visibility]
        distance = np.hypot(objects[:, 1], objects[:, 2])
        parts = {"all": distance >= 0, "0-25 m": distance < 25.0, "over 25 m": distance >= 25.0}
        for name, mask in parts.items():
            value, low, high = bootstrap_over_drives(objects[mask], correlate_visibility_with_score)
            console.print(f"{rig}, {name}: Spearman {value:.2f} ({low:.2f} to {high:.2f}), {mask.sum()} cars")
        value, low, high = bootstrap_over_drives(objects, correlate_visibility_with_recall, num_samples=300)
        console.print(f"{rig}, cells of 6.4 m: Spearman {value:.2f} ({low:.2f} to {high:.2f})")


def plot_results(results, path):
    """Plot recall over visibility and over distance, AP and coverage."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(14.0, 4.4), layout="constrained")
    row = SCORES.index(OPERATING_SCORE)
    for ax, axis in ((left, "visibility"), (middle, "distance")):
        curves = [module.counts.compute_curve(axis) for module, _ in results.values()]
        cars = torch.stack([curve.recall.trials[row] for curve in curves], dim=1)
        shown = [index for index in range(len(cars)) if cars[index].any()]
        num_on_axis = sum(curves[0].bins[index][0].isdigit() for index in shown)  # the bin `hidden` is not on the axis
        for shift, rig, curve in zip((-0.05, 0.05), results, curves, strict=True):
            value, low, high = (
                values[row, shown].cpu().numpy() for values in (curve.recall.value, curve.recall.low, curve.recall.high)
            )
            x, error = np.arange(len(shown)) + shift, np.abs(np.stack([value - low, high - value]))
            marks = ax.errorbar(x, value, error, fmt="o", capsize=3, label=rig)
            ax.plot(x[:num_on_axis], value[:num_on_axis], color=marks[0].get_color())
        labels = ["\n".join(map(str, [curves[0].bins[index], *cars[index].tolist()])) for index in shown]
        ax.set_xticks(range(len(shown)), labels)
        ax.set(xlabel=f"{axis} of the car; below, number of cars for each rig", ylabel="recall", ylim=(0, 1.03))
    for shift, (rig, (module, coverage)) in zip((-0.2, 0.2), results.items(), strict=True):
        rates = [row.numbers["detection_0.4m"] for row in coverage.summary(REGIONS)]
        bars = [compute_average_precision(module.counts), *(rate.value for rate in rates)]
        errors = [math.nan, *(rate.error for rate in rates)]
        right.bar(np.arange(len(bars)) + shift, bars, width=0.38, yerr=errors, capsize=3, label=rig)
    right.set_xticks(range(3), ["AP", *(f"detected within\n0.4 m, {region.name}" for region in REGIONS)])
    right.set(ylim=(0, 1))
    right.legend()
    left.set_title(f"recall at score {OPERATING_SCORE}, 95 % Wilson intervals")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main():
    """Simulate the frames, train both detectors and report the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=192, help="number of training frames")
    parser.add_argument("--validate", type=int, default=64, help="number of validation frames, four per drive")
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--labels", type=int, choices=STUDENT_T, help="number of seeds to compare labels with")
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
        metric = build_coverage_metric(has_area_weights=True)
        results[rig] = train(rig, training_frames, validation_frames, metric, options, console)
    print_report(results, console)
    plot_results(results, options.out / "detector.png")
    console.print(f"Wrote {options.out / 'detector.png'} and event files for TensorBoard")


if __name__ == "__main__":
    main()
