"""Notes on a result: an early end, sensor models, weather, test targets, the reference sensor and repeated frames."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchcover.coverage import Coverage, Region, TargetSums
from torchcover.estimation import MIN_BLOCKS
from torchcover.evaluation.pipeline import Run
from torchcover.simulation import CameraSensor, Sensor
from torchcover.simulation.sensor import ScanTimes


def describe_failure(failure: BaseException, num_frames: int) -> str:
    """Describe the early end of a run.

    Args:
        failure: Error that ended the run.
        num_frames: Number of frames until then.

    Returns:
        A sentence with the first line of the error.

    Example:
        >>> describe_failure(ValueError("no points"), 3)
        'The run was cut short after 3 frames: ValueError: no points.'
    """
    start = f"The run was cut short after {num_frames:,} frame{'s' * (num_frames != 1)}"
    if isinstance(failure, KeyboardInterrupt):
        return f"{start}: interrupted."
    reason = ": ".join([type(failure).__name__, *str(failure).strip().splitlines()[:1]])
    return f"{start}: {reason.rstrip('.')}."


def describe_sensor_models(model_by_rig: object) -> list[str]:
    """Describe which sensor models were used.

    Args:
        model_by_rig: Name of the rig -> "real" or "ideal", as in a record; anything else counts as unknown.

    Returns:
        One sentence; none if the models are unknown.

    Example:
        >>> describe_sensor_models({"kitti": "real"})
        ['Sensor model: real, range-limited returns (reflectivity, incidence angle, weather).']
    """
    if not isinstance(model_by_rig, Mapping) or not model_by_rig:
        return []
    meanings = {
        "real": "range-limited returns (reflectivity, incidence angle, weather)",
        "ideal": "every hit is a point",
    }
    models = set(model_by_rig.values())
    if len(models) == 1:
        (model,) = models
        return [f"Sensor model: {model}, {meanings[model]}."]
    listed = ", ".join(f"{rig} {model}" for rig, model in model_by_rig.items())
    return [f"Sensor models differ: {listed}; differences between rigs include their effect."]


def describe_weather(weather_by_rig: object) -> list[str]:
    """Describe the weather of a run.

    Args:
        weather_by_rig: Name of the rig -> name of its weather, as in a record; anything else counts as unknown.

    Returns:
        One sentence; none in clear air or if the weather is unknown.

    Example:
        >>> describe_weather({"kitti, clear": "clear", "kitti, fog_100m": "fog_100m"})
        ['Weather: clear, fog_100m.']
    """
    names = dict.fromkeys(weather_by_rig.values()) if isinstance(weather_by_rig, Mapping) else {}
    return [f"Weather: {', '.join(names)}."] if names and list(names) != ["clear"] else []


def describe_perfect_depth(sensors: Mapping[str, Sequence[Sensor]]) -> list[str]:
    """Name the cameras whose depth counts as exact because their range error is not given.

    Args:
        sensors: Name of the rig -> its sensors.

    Returns:
        One sentence; none if every camera has a range error.

    Example:
        >>> from torchcover.simulation import CameraSensor
        >>> front = CameraSensor(name="front", width=64, height=48, fov_deg=90, max_range_m=100)
        >>> describe_perfect_depth({"van": [front]})[0][:54]
        'Perfect depth is assumed for cameras of van (front): a'
        >>> describe_perfect_depth({"van": [front.model_copy(update={"range_noise_share": 0.02})]})
        []
    """
    descriptions = []
    for rig, rig_sensors in sensors.items():
        cameras = [sensor for sensor in rig_sensors if isinstance(sensor, CameraSensor)]
        exact = [camera.name for camera in cameras if not np.any(camera.compute_noise_std_m(np.ones(1)))]
        if exact:
            descriptions.append(f"{rig} ({', '.join(exact)})")
    if not descriptions:
        return []
    return [
        f"Perfect depth is assumed for cameras of {'; '.join(descriptions)}: a pixel measures its range exactly; add "
        "`stereo` or `range_noise_share`."
    ]


def describe_scan_periods(sensors: Mapping[str, Sequence[Sensor]]) -> list[str]:
    """Warn of a comparison of rigs whose sensors take different times for a scan.

    Args:
        sensors: Name of the rig -> its sensors.

    Returns:
        One sentence; none if all rigs have the same scan periods.

    Example:
        >>> from torchcover.simulation import CameraSensor
        >>> camera = CameraSensor(name="front", width=64, height=48, fov_deg=90, max_range_m=100)
        >>> rolling = CameraSensor(**camera.model_dump() | {"scan": {"period_s": 0.05}})
        >>> describe_scan_periods({"global": [camera], "rolling": [rolling]})[0][:58]
        'Scan periods differ: global at once, rolling 0.05 s. Motio'
    """
    periods_s = {}
    for rig, rig_sensors in sensors.items():
        if rig_sensors:
            periods_s[rig] = sorted({_get_scan_period_s(sensor) for sensor in rig_sensors})
    # Rigs with equal sets of periods are distorted by motion in the same way.
    if len({tuple(rig_periods_s) for rig_periods_s in periods_s.values()}) < 2:
        return []
    descriptions = []
    for rig, rig_periods_s in periods_s.items():
        texts = [f"{period_s:g} s" if period_s else "at once" for period_s in rig_periods_s]
        descriptions.append(f"{rig} {' and '.join(texts)}")
    listed = ", ".join(descriptions)
    return [f"Scan periods differ: {listed}. Motion during the scan changes numbers of the near field."]


def _get_scan_period_s(sensor: Sensor) -> float:
    """Return the time from the first to the last ray; 0 if all rays are cast at once."""
    timing: ScanTimes | None = getattr(sensor, "scan", None)
    return timing.period_s if timing else 0.0


def describe_test_targets(
    target_sums: Mapping[str, TargetSums], regions: Sequence[Region], *, is_recording: bool
) -> list[str]:
    """Describe where test targets were placed, or why a recording has none.

    Args:
        target_sums: Name of each rig -> visibility of test targets; empty without them.
        regions: Regions of the numbers.
        is_recording: Whether the frames are recorded.
    """
    if target_sums:
        num_frames = int(next(iter(target_sums.values())).frame_counts.sum())
        return [
            f"Test targets: in {num_frames:,} frame{'s' * (num_frames != 1)}, one at a time, at random positions whose "
            "center is in the region; they occlude nothing else."
        ]
    if is_recording and any(region.bands for region in regions):
        return ["No test targets in the near field: a recording has no scene to place them in."]
    return []


def describe_reference(record: Mapping[str, Any], run: Run, coverage: Coverage) -> list[str]:
    """Describe the reference points of a run, and how many frames of a simulation are distinct.

    Args:
        record: Source of the reference points, see `Result.used_reference`.
        run: Outcome of the run.
        coverage: Coverage of a rig.
    """
    if "frame_interval_s" not in record:  # a recording
        return list(record["notes"])
    sensor = (
        f"Reference sensor: {record['sensor']}, {record['rays_per_frame']:,} rays per frame; frame interval "
        f"{record['frame_interval_s']:g} s."
    )
    return [
        sensor,
        *record["notes"],
        *_describe_resampled_poses(run.counts),
        *_describe_repeated_frames(run, coverage),
    ]


def _describe_resampled_poses(counts: Mapping[str, int], min_share: float = 0.2) -> list[str]:
    """Warn if at least `min_share` of the reference poses were sampled again, which suggests an error in the scene."""
    resampled, sampled = counts["reference_poses_resampled"], counts["reference_poses"]
    if resampled < min_share * sampled:
        return []
    return [
        f"{resampled:,} of {sampled:,} poses of the reference sensor ({resampled / sampled:.0%}) lay inside bodies or "
        "below the ground and were sampled again. Check that the ego vehicle stands on the ground and that faces point "
        "outwards."
    ]


def _describe_repeated_frames(run: Run, coverage: Coverage) -> list[str]:
    """Note that frames repeat earlier time steps of the scenario, which adds no information."""
    repeated = run.counts["repeated_frames"]
    if not repeated:
        return []
    distinct = run.num_frames - repeated
    block_sums: Any = coverage.block_sums
    has_errors = block_sums is not None and int((block_sums.frame_counts > 0).sum()) >= MIN_BLOCKS
    if distinct == 1:
        limit = ", so confidence intervals only cover the sampling of reference poses" if has_errors else ""
        return [f"All {run.num_frames:,} frames show the same time step{limit}."]
    effect = ", and confidence intervals account for this" if has_errors else ""
    return [f"{run.num_frames:,} frames show {distinct:,} distinct time steps: the scenario repeats{effect}."]
