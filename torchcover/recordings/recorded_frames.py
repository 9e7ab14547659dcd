"""Frames of a recording."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
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
from torchcover.frames.source import BadFrameError, FrameDataset
from torchcover.geometry import transform_points
from torchcover.recordings.accumulated_reference import AccumulatedReference
from torchcover.recordings.recording import Recording
from torchcover.recordings.reference import RecordedReference, Reference
from torchcover.recordings.sweep_window import SweepWindow
from torchcover.recordings.vehicle_cloud import VehicleCloud, join_clouds, transform_to_vehicle

NO_GROUND = "Ground: none was found near the vehicle, so heights are z of the vehicle frame."
SEEN_GROUND = "Ground: a height field through what all sensors saw of it; unknown farther than 10 m from that."
# What a folder of results holds, during the run or after it.
RESULTS = frozenset({"summary.json", "checkpoint.npz"})


class RecordedFrames(FrameDataset):
    """What the sensors of a recording saw compared with a reference, instant by instant. A map-style torch Dataset.

    Points that are not finite, never came back (they lie in the sensor) or lie on the vehicle itself are in neither
    cloud; `Frame.counts` says how many (`sensor_nonfinite`, `reference_no_return`, ...). An empty sensor cloud is a
    blind step; an empty reference cloud is an error, for nothing was measured, unless the vehicle stands still in the
    window of an `AccumulatedReference`: such a frame says nothing, and `Frame.counts` has `reference_stationary`.

    Args:
        recording: A recording, or the path of one; see `open_recording`.
        rigs: Names of rigs -> names of their sensors; those of the recording if not given.
        reference: Where the reference clouds come from. Not given: the sensors that were recorded for it, or
            else an `AccumulatedReference`.
        use_ground_model: Whether heights above the ground that were not recorded, also of boxes, come from a `GroundModel` of
            what all sensors saw: within the window of the reference if it is accumulated, else at the instant.

    Raises:
        FileNotFoundError: There is no such recording, or a part of it is missing.
        ValueError: What is no recording, sensors that it does not have, no reference. From indexing: `BadFrameError`.

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
            from torchcover.recordings.formats import open_recording  # all formats, for a path only

            recording = open_recording(recording)
        self.recording = recording
        settings = getattr(recording, "settings", None)
        self.corrections: str = settings.command_line_options if settings else ""
        self.sensors_by_rig = {name: tuple(of) for name, of in (rigs or self.recording.rigs).items()}
        self._check_sensors()
        if reference is None:
            reference = RecordedReference() if self.recording.reference_sensors else AccumulatedReference()
        self.reference = reference
        self.reference.check(self.recording, self._judged)
        self.use_ground_model = use_ground_model
        self._sweeps = (
            self.reference.sweep_window if isinstance(self.reference, AccumulatedReference) else SweepWindow(0.0)
        )
        self._has_heights: bool | None = None
        self._modelled = False

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_link_roots": find_link_roots(self.recording.path)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        allow_links(state["recording"].path, state.pop("_link_roots"))
        self.__dict__.update(state)

    def skip_unreadable_sweeps(self) -> None:
        """A scan that cannot be read costs its own frame, and not all whose window it is in; those count it."""
        self._sweeps.skip_unreadable = True

    @property
    def frame_names(self) -> Sequence[str]:
        """What a user calls the frames."""
        return tuple(self.recording.frame_names[instant] for instant in self.recording.key_frames)

    @property
    def rigs(self) -> tuple[str, ...]:
        """Names of the rigs."""
        return tuple(self.sensors_by_rig)

    @property
    def sensors(self) -> Mapping[str, tuple[()]]:
        """Nothing: a recording does not say how its sensors scan."""
        return {}

    @property
    def sensor_names(self) -> Mapping[str, tuple[str, ...]]:
        """The names of the sensors of each rig."""
        return self.sensors_by_rig

    def get_scene_id(self, index: int) -> int:
        """The index: nothing has to be built."""
        return index

    def get_block_index(self, index: int) -> int:
        """The window of a frame; frames of one window share most of their reference points."""
        return self._block_indices[index]

    def has_boxes(self) -> bool:
        """Whether the first frame whose boxes can be read has any, or says that there are none."""
        for instant in self.recording.key_frames:
            try:
                return self.recording.read_boxes(instant) is not None
            except (OSError, ValueError):
                continue  # whoever measures it will say so
        return False

    def has_heights(self) -> bool:
        """Whether the first frame that can be read and has a reference has any, recorded or above a ground model."""
        for position in range(len(self) if self._has_heights is None else 0):
            if self._is_standing(position):
                continue
            try:
                heights_m = self[position].reference_heights_m
            except BadFrameError:
                continue  # whoever measures it will say so
            self._has_heights = heights_m is not None and bool(heights_m.isfinite().any())
            break
        self._has_heights = bool(self._has_heights)
        return self._has_heights

    def check(self, num_frames: int | None = None) -> Sequence[str]:
        """Faults of the recording with their remedies, as `torchcover.recordings.checks` finds them."""
        from torchcover.recordings.checks import check_recording  # only before a measurement

        num_checked_frames = len(self) if num_frames is None else min(num_frames, len(self))
        return check_recording(self.recording, self.reference, self.sensors_by_rig, num_checked_frames)

    @property
    def ego_outline_m(self) -> NDArray[np.float64] | None:
        """The outline of the vehicle, if the recording says how large it is."""
        body = self.recording.ego_box
        return None if body is None else body.outline_m

    @property
    def description(self) -> Mapping[str, object]:
        """Where the recording is."""
        return {"scenario": None, "vehicle": None, "frames": str(self.recording.path), "seed": None}

    @property
    def has_area_weights(self) -> bool:
        """Whether the reference has the square metres of its points."""
        return self.reference.has_area_weights(self.recording)

    @property
    def reference_record(self) -> Mapping[str, object]:
        """Where the reference comes from, and the ground, if it was looked for to choose what bands are over."""
        record = self.reference.describe(self.recording, self._judged)
        if self.corrections:
            notes = [*record["notes"], f"Read as asked: {self.corrections}."]  # type: ignore[misc]  # as below
            record = {**record, "notes": notes}
        if self._has_heights is None or not self._modelled:
            return record
        words = SEEN_GROUND if self._has_heights else NO_GROUND
        return {**record, "notes": [*record["notes"], words]}  # type: ignore[misc]  # sentences, as it says

    @property
    def content(self) -> Mapping[str, object]:
        """Names, sizes and times of change of its files, which are not read for it, and what is made of them.

        Raises:
            OSError: A file is gone.
        """
        reference = {name: value for name, value in vars(self.reference).items() if not name.startswith("_")}
        return {
            "recording": list(_stamps(self.recording.path)),
            "instants": [list(self.recording.frame_names), list(self.recording.key_frames)],
            "sensors": self.sensors_by_rig,
            "told": [repr(self.recording.ego_box), getattr(self.recording, "told", {})],
            "reference": [type(self.reference).__name__, reference],
            "ground": self.use_ground_model,
            "corrections": self.corrections,
        }

    def __len__(self) -> int:
        return len(self.recording.key_frames)

    def _frame_at(self, position: int) -> Frame:
        instant = self.recording.key_frames[position]
        name = self.recording.frame_names[instant]
        try:
            scans = {sensor: self._read(sensor, instant) for sensor in self._judged}
            reference = self.reference.build_cloud(self.recording, instant, self._judged)
            heights_m, boxes = self._above_ground(instant, reference, self.recording.read_boxes(instant))
        except BadFrameError as error:
            window = f"it is in the window of {name} (frame {position}); --set skip_bad_frames=true leaves it out"
            raise BadFrameError(f"{error}; {window}") from error
        except (OSError, ValueError) as error:
            raise BadFrameError(f"{name} (frame {position}): {error}") from error
        dropped = sum((scan.excluded_counts for scan in scans.values()), Counter[str]())
        clouds = {rig: join_clouds([scans[sensor] for sensor in of]) for rig, of in self.sensors_by_rig.items()}
        counts = {
            f"{side}_{why}": number[why]
            for side, number in (("sensor", dropped), ("reference", reference.excluded_counts))
            for why in sorted({"nonfinite", "no_return", "ego_vehicle", *number})
        }
        tensors = {rig: torch.from_numpy(cloud.points_m) for rig, cloud in clouds.items()}
        if boxes is not None:
            boxes = add_point_counts(boxes, tensors)
        return Frame(
            tensors,
            torch.from_numpy(reference.points_m),
            position,
            name,
            counts=counts,
            reference_weights=None if reference.weights is None else torch.from_numpy(reference.weights),
            reference_heights_m=None if heights_m is None else torch.from_numpy(heights_m),
            boxes=boxes,
            block_index=self._block_indices[position],
            sensor_point_counts={
                rig: {sensor: len(scans[sensor].points_m) for sensor in of} for rig, of in self.sensors_by_rig.items()
            },
        )

    @property
    def _judged(self) -> tuple[str, ...]:
        """The sensors of all rigs, each once."""
        return tuple(dict.fromkeys(sensor for of in self.sensors_by_rig.values() for sensor in of))

    @cached_property
    def _block_indices(self) -> Sequence[int]:
        """Of each frame; those within one window share most of their reference points, and so a place."""
        frames, recording, window_s = list(self.recording.key_frames), self.recording, self._sweeps.window_s
        places = (
            list(range(len(frames)))
            if recording.block_indices is None
            else [recording.block_indices[at] for at in frames]
        )
        if not window_s or recording.times_s is None or not frames:
            return places
        windows = np.floor((recording.times_s[frames] - recording.times_s[frames[0]]) / window_s + 1e-6)
        first = dict(zip(reversed(places), reversed(windows.tolist()), strict=True))  # of an instant that is seen again
        _, ranks = np.unique([first[place] for place in places], return_inverse=True)
        return [int(rank) for rank in ranks]

    def _is_standing(self, position: int) -> bool:
        """Return whether the vehicle stands still in the window of a frame, which has no reference points then."""
        reference, instant = self.reference, self.recording.key_frames[position]
        return isinstance(reference, AccumulatedReference) and reference.is_stationary(
            self.recording, instant, self._judged
        )

    def _read(self, sensor: str, instant: int) -> VehicleCloud:
        return transform_to_vehicle(self.recording.read_scan(sensor, instant), self.recording.ego_box)

    def _above_ground(
        self, instant: int, reference: VehicleCloud, boxes: Boxes | None
    ) -> tuple[NDArray[np.float32] | None, Boxes | None]:
        """The heights of the reference points, and the boxes with those of their bottoms."""
        # Recorded points with square metres, but without heights, were drawn for bands over z.
        drawn = reference.weights is not None and isinstance(self.reference, RecordedReference)
        if reference.heights_m is not None or drawn or not self.use_ground_model:
            return reference.heights_m, boxes
        ground = self._sweeps.get_ground_model(self.recording, instant)
        self._modelled = True
        if ground is None:
            if self._has_heights is False:
                return None, boxes  # nowhere, so that bands are over z
            return np.full(len(reference.points_m), np.nan, dtype=np.float32), boxes
        local_T_vehicle = self._sweeps.compute_local_T_vehicle(self.recording, instant)
        if boxes is not None:
            centres_m = transform_points(local_T_vehicle, boxes.center_m.double().numpy())
            bottoms_m = torch.from_numpy(ground.compute_heights_m(centres_m)).to(boxes.size_m) - boxes.size_m[:, 2] / 2
            known = boxes.bottom_heights_m
            boxes = replace(boxes, bottom_heights_m=torch.where(known.isnan(), bottoms_m, known))
        return ground.compute_heights_m(transform_points(local_T_vehicle, reference.points_m)).astype(np.float32), boxes

    def _check_sensors(self) -> None:
        there = (*self.recording.sensors, *self.recording.reference_sensors)
        for rig, sensors in self.sensors_by_rig.items():
            unknown = [sensor for sensor in sensors if sensor not in there]
            if unknown or not sensors:
                raise ValueError(
                    f"rig {rig!r}: sensors of the recording {self.recording.path} are needed, which has "
                    f"{', '.join(there)}; got {', '.join(unknown) or 'none'}"
                )


def _stamps(place: Path) -> Iterator[tuple[str, int, int]]:
    """Path, size and time of change of every file; those of results that are kept in its folder are no part of it."""
    if place.is_file():
        yield place.name, place.stat().st_size, place.stat().st_mtime_ns
    for folder, folders, names in os.walk(place):
        if not RESULTS.isdisjoint(names):
            folders.clear()
            continue
        folders.sort()
        for name in sorted(names):
            status = Path(folder, name).stat()
            yield Path(folder, name).relative_to(place).as_posix(), status.st_size, status.st_mtime_ns


def create_reference(name: str | None = None, window_s: float | None = None) -> Reference | None:
    """The reference of a recording by its name.

    Args:
        name: "recorded" or "accumulated"; None for what the recording has.
        window_s: Time over which one is accumulated, in seconds.

    Raises:
        ValueError: Another name, or a time for one that was recorded.

    Example:
        >>> create_reference("accumulated", 1.0).window_s
        1.0
    """
    if name not in (None, "recorded", "accumulated"):
        raise ValueError(f"reference {name}: for a recording `recorded` or `accumulated` is needed")
    if name == "accumulated" or window_s is not None:
        if name == "recorded":
            raise ValueError(
                f"window: a recorded reference has none; got {window_s:g} s; leave it out, or accumulate one"
            )
        return AccumulatedReference() if window_s is None else AccumulatedReference(window_s)
    return RecordedReference() if name == "recorded" else None
