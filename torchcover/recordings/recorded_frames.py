"""Frames of a recording: sensor and reference points of each frame in the vehicle frame."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchcover.detection import Boxes
from torchcover.detection.inside import add_point_counts
from torchcover.files import allow_links, find_link_roots
from torchcover.frames.frame import Frame
from torchcover.frames.source import BadFrameError, FrameDataset, FrameMetadata
from torchcover.geometry import transform_points
from torchcover.recordings.accumulated_reference import AccumulatedReference
from torchcover.recordings.recording import Recording
from torchcover.recordings.reference import RecordedReference, Reference
from torchcover.recordings.sweep_window import SweepWindow
from torchcover.recordings.vehicle_cloud import VehicleCloud, join_clouds, transform_to_vehicle


class RecordedFrames(FrameDataset):
    """Map-style torch Dataset of the frames of a recording with the reference points of each.

    Points that are not finite, have no return (they lie in the sensor) or lie on the ego vehicle are excluded from both
    clouds and counted in `Frame.counts` (`sensor_nonfinite`, `reference_no_return`, ...). A frame without sensor points
    is valid. A frame without reference points is an error, unless the vehicle is stationary in the window of an
    `AccumulatedReference`: then nothing is measured, and `Frame.counts` has `reference_stationary`.

    Args:
        recording: A recording, or the path of one; see `open_recording`.
        rigs: Names of rigs -> names of their sensors; those of the recording if not given.
        reference: Source of the reference clouds. Not given: the reference sensors of the recording, or else an
            `AccumulatedReference`.
        use_ground_model: Whether heights above ground that were not recorded, also of boxes, come from a `GroundModel`
            of the points of all sensors: within the window of an accumulated reference, else in the frame.

    Raises:
        FileNotFoundError: There is no such recording, or a part of it is missing.
        ValueError: Not a recording, sensors that it does not have, or no reference.
        BadFrameError: From indexing: a frame cannot be read.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for source in ("sensor", "reference"):
        ...         Path(folder, source).mkdir()
        ...         _ = Path(folder, source, "frame7.xyz").write_text("1 2 3")
        ...     [(frame.name, frame.sensor.tolist()) for frame in RecordedFrames(folder)]
        [('frame7', [[1.0, 2.0, 3.0]])]
    """

    def __init__(
        self,
        recording: Recording | str | os.PathLike[str],
        *,
        rigs: Mapping[str, Sequence[str]] | None = None,
        reference: Reference | None = None,
        use_ground_model: bool = True,
    ) -> None:
        if isinstance(recording, str | os.PathLike):
            from torchcover.recordings.formats import open_recording  # loads all formats, needed for a path only

            recording = open_recording(recording)
        self.recording = recording
        settings = getattr(recording, "settings", None)
        self.corrections: str = settings.command_line_options if settings else ""
        self.sensors_by_rig = {rig: tuple(sensors) for rig, sensors in (rigs or self.recording.rigs).items()}
        self._check_sensors()
        if reference is None:
            reference = RecordedReference() if self.recording.reference_sensors else AccumulatedReference()
        self.reference = reference
        self.reference.check(self.recording, self._evaluated_sensors)
        self.use_ground_model = use_ground_model
        self._sweeps = reference.sweep_window if isinstance(reference, AccumulatedReference) else SweepWindow(0.0)
        self._has_heights: bool | None = None  # unknown before the first call of `has_heights`
        self._has_used_ground_model = False

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_link_roots": find_link_roots(self.recording.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        allow_links(state["recording"].path, state.pop("_link_roots"))
        self.__dict__.update(state)

    def skip_unreadable_sweeps(self) -> None:
        """Let an unreadable scan fail its own frame only; other frames whose window contains it count it."""
        self._sweeps.skip_unreadable = True

    @property
    def frame_names(self) -> Sequence[str]:
        """Names of the frames as users know them, such as file names."""
        return tuple(self.recording.frame_names[frame] for frame in self.recording.key_frames)

    @property
    def metadata(self) -> FrameMetadata:
        """Rigs, vehicle and path; a recording does not describe the scan patterns of its sensors."""
        ego_box = self.recording.ego_box
        return FrameMetadata(
            rigs=tuple(self.sensors_by_rig),
            description={"scenario": None, "vehicle": None, "frames": str(self.recording.path), "seed": None},
            has_area_weights=self.reference.has_area_weights(self.recording),
            has_boxes=self._has_boxes(),
            sensor_names=self.sensors_by_rig,
            ego_outline_m=None if ego_box is None else ego_box.outline_m,
        )

    def get_block_index(self, index: int) -> int:
        """Get the block of a frame; frames of one window share most of their reference points and so their block.

        Args:
            index: Index of the frame.
        """
        return self._block_indices[index]

    def _has_boxes(self) -> bool:
        """Return whether the first frame with readable labels has boxes, or none but is labeled."""
        for frame in self.recording.key_frames:
            try:
                return self.recording.read_boxes(frame) is not None
            except (OSError, ValueError):
                continue  # reported when the frame is measured
        return False

    def has_heights(self) -> bool:
        """Return whether the first readable frame with a reference has heights, recorded or above a ground model."""
        for index in range(len(self) if self._has_heights is None else 0):
            if self._is_stationary(index):
                continue
            try:
                heights_m = self[index].reference_heights_m
            except BadFrameError:
                continue  # reported when the frame is measured
            self._has_heights = heights_m is not None and bool(heights_m.isfinite().any())
            break
        self._has_heights = bool(self._has_heights)
        return self._has_heights

    def check(self, num_frames: int | None = None) -> Sequence[str]:
        """Check the recording for known errors, see `torchcover.recordings.checks`.

        Args:
            num_frames: Number of frames that will be measured, from the first on; all if not given.

        Returns:
            A message with a remedy for each error.
        """
        from torchcover.recordings.checks import check_recording  # only before a measurement

        num_checked_frames = len(self) if num_frames is None else min(num_frames, len(self))
        return check_recording(self.recording, self.reference, self.sensors_by_rig, num_checked_frames)

    def describe_reference(self) -> Mapping[str, object]:
        """Describe the reference, corrections, and the ground if height bands depend on it."""
        record = self.reference.describe(self.recording, self._evaluated_sensors)
        notes: list[str] = [*record["notes"]]  # type: ignore[misc]  # sentences, see `Reference.describe`
        if self.corrections:
            notes.append(f"Corrections of the recording: {self.corrections}.")
        if self._has_heights is not None and self._has_used_ground_model:
            notes.append(
                "Ground: height field through the ground points of all sensors; unknown farther than 10 m from them."
                if self._has_heights
                else "Ground: none was found near the vehicle, so heights are z of the vehicle frame."
            )
        return {**record, "notes": notes}

    def collect_content(self) -> Mapping[str, object]:
        """Collect names, sizes and modification times of the files, which are not read, and all settings.

        Raises:
            OSError: A file is gone.
        """
        reference: dict[str, object] = {}
        for name, value in vars(self.reference).items():
            if not name.startswith("_"):
                reference[name] = asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
        return {
            "recording": list(_list_file_stamps(self.recording.path)),
            "frames": [list(self.recording.frame_names), list(self.recording.key_frames)],
            "sensors": self.sensors_by_rig,
            "reader_options": [repr(self.recording.ego_box), getattr(self.recording, "reader_options", {})],
            "reference": [type(self.reference).__name__, reference],
            "use_ground_model": self.use_ground_model,
            "corrections": self.corrections,
        }

    def __len__(self) -> int:
        return len(self.recording.key_frames)

    def make_frame(self, index: int) -> Frame:
        """Read one frame."""
        frame = self.recording.key_frames[index]
        name = self.recording.frame_names[frame]
        try:
            scans = {sensor: self._read_cloud(sensor, frame) for sensor in self._evaluated_sensors}
            reference = self.reference.build_cloud(self.recording, frame, self._evaluated_sensors)
            heights_m, boxes = self._compute_heights(frame, reference, self.recording.read_boxes(frame))
        except BadFrameError as error:
            window = f"it is in the window of {name} (frame {index}); --set skip_bad_frames=true skips it"
            raise BadFrameError(f"{error}; {window}") from error
        except (OSError, ValueError) as error:
            raise BadFrameError(f"{name} (frame {index}): {error}") from error
        clouds: dict[str, torch.Tensor] = {}
        sensor_point_counts: dict[str, dict[str, int]] = {}
        for rig, sensors in self.sensors_by_rig.items():
            clouds[rig] = torch.from_numpy(join_clouds([scans[sensor] for sensor in sensors]).points_m)
            sensor_point_counts[rig] = {sensor: len(scans[sensor].points_m) for sensor in sensors}
        sensor_counts = sum((scan.excluded_counts for scan in scans.values()), Counter[str]())
        counts: dict[str, int] = {}
        for side, side_counts in (("sensor", sensor_counts), ("reference", reference.excluded_counts)):
            for reason in sorted({"nonfinite", "no_return", "ego_vehicle", *side_counts}):
                counts[f"{side}_{reason}"] = side_counts[reason]
        return Frame(
            clouds,
            torch.from_numpy(reference.points_m),
            index,
            name,
            counts=counts,
            reference_weights=None if reference.weights is None else torch.from_numpy(reference.weights),
            reference_heights_m=None if heights_m is None else torch.from_numpy(heights_m),
            boxes=None if boxes is None else add_point_counts(boxes, clouds),
            block_index=self._block_indices[index],
            sensor_point_counts=sensor_point_counts,
        )

    @property
    def _evaluated_sensors(self) -> tuple[str, ...]:
        """Sensors of all rigs, each once."""
        return tuple(dict.fromkeys(sensor for sensors in self.sensors_by_rig.values() for sensor in sensors))

    @cached_property
    def _block_indices(self) -> Sequence[int]:
        """Block of each frame: frames within one window share most of their reference points."""
        frames, times_s, window_s = list(self.recording.key_frames), self.recording.times_s, self._sweeps.window_s
        recorded_blocks = self.recording.block_indices
        blocks = list(range(len(frames)))
        if recorded_blocks is not None:
            blocks = [recorded_blocks[frame] for frame in frames]
        if not window_s or times_s is None or not frames:
            return blocks
        windows = np.floor((times_s[frames] - times_s[frames[0]]) / window_s + 1e-6).tolist()
        # The first window of a block counts if a place is recorded again later.
        first_window = dict(zip(reversed(blocks), reversed(windows), strict=True))
        _, ranks = np.unique([first_window[block] for block in blocks], return_inverse=True)
        return [int(rank) for rank in ranks]

    def _is_stationary(self, index: int) -> bool:
        """Test whether a frame has no reference points because the vehicle is stationary in its window."""
        reference, frame = self.reference, self.recording.key_frames[index]
        return isinstance(reference, AccumulatedReference) and reference.is_stationary(
            self.recording, frame, self._evaluated_sensors
        )

    def _read_cloud(self, sensor: str, frame: int) -> VehicleCloud:
        return transform_to_vehicle(self.recording.read_scan(sensor, frame), self.recording.ego_box)

    def _compute_heights(
        self, frame: int, reference: VehicleCloud, boxes: Boxes | None
    ) -> tuple[NDArray[np.float32] | None, Boxes | None]:
        """Compute the heights of the reference points above ground, and those of the bottoms of the boxes."""
        # Recorded points with areas, but without heights, were sampled for height bands over z.
        is_sampled_over_z = reference.weights is not None and isinstance(self.reference, RecordedReference)
        if reference.heights_m is not None or is_sampled_over_z or not self.use_ground_model:
            return reference.heights_m, boxes
        ground = self._sweeps.get_ground_model(self.recording, frame)
        self._has_used_ground_model = True
        if ground is None:
            if self._has_heights is False:
                return None, boxes  # no frame has ground, so height bands are over z
            return np.full(len(reference.points_m), np.nan, dtype=np.float32), boxes
        local_T_vehicle = self._sweeps.compute_local_T_vehicle(self.recording, frame)
        if boxes is not None:
            centers_m = transform_points(local_T_vehicle, boxes.center_m.double().numpy())
            bottoms_m = torch.from_numpy(ground.compute_heights_m(centers_m)).to(boxes.size_m) - boxes.size_m[:, 2] / 2
            recorded_m = boxes.bottom_heights_m
            boxes = replace(boxes, bottom_heights_m=torch.where(recorded_m.isnan(), bottoms_m, recorded_m))
        return ground.compute_heights_m(transform_points(local_T_vehicle, reference.points_m)).astype(np.float32), boxes

    def _check_sensors(self) -> None:
        available = (*self.recording.sensors, *self.recording.reference_sensors)
        for rig, sensors in self.sensors_by_rig.items():
            unknown = [sensor for sensor in sensors if sensor not in available]
            if unknown or not sensors:
                raise ValueError(
                    f"rig {rig!r}: got {', '.join(unknown) or 'no sensor'}; give sensors of the recording "
                    f"{self.recording.path}: {', '.join(available)}"
                )


def _list_file_stamps(path: Path) -> Iterator[tuple[str, int, int]]:
    """List path, size and modification time of each file of a recording, without results stored in its folder."""
    if path.is_file():
        yield path.name, path.stat().st_size, path.stat().st_mtime_ns
    for folder, subfolders, names in os.walk(path):
        if {"summary.json", "checkpoint.npz"} & set(names):  # results of a finished or unfinished run
            subfolders.clear()
            continue
        subfolders.sort()
        for name in sorted(names):
            status = Path(folder, name).stat()
            yield Path(folder, name).relative_to(path).as_posix(), status.st_size, status.st_mtime_ns


def create_reference(name: str | None = None, window_s: float | None = None) -> Reference | None:
    """Create the reference of a recording by name.

    Args:
        name: "recorded" or "accumulated"; None for the default of the recording.
        window_s: Accumulation window in seconds.

    Returns:
        The reference; None for the default of the recording.

    Raises:
        ValueError: The name is unknown, or a recorded reference gets a window.

    Example:
        >>> create_reference("accumulated", 1.0).window_s
        1.0
    """
    if name not in (None, "recorded", "accumulated"):
        raise ValueError(f"reference: got {name!r}; a recording has `recorded` or `accumulated`")
    if name == "accumulated" or window_s is not None:
        if name == "recorded":
            raise ValueError(
                f"window: a recorded reference has none; got {window_s:g} s; leave it out, or accumulate one"
            )
        return AccumulatedReference() if window_s is None else AccumulatedReference(window_s)
    return RecordedReference() if name == "recorded" else None
