"""Simulated frames: sensor and reference points of rigs in a scenario, and the choice of the reference sensor."""

import copy
import hashlib
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.detection.boxes import Boxes
from torchcover.detection.inside import add_point_counts
from torchcover.frames.frame import Frame, Measurement
from torchcover.frames.source import FrameDataset, FrameMetadata
from torchcover.simulation.kinds import REFERENCE_SENSORS
from torchcover.simulation.mounted_sensor import describe_self_hits
from torchcover.simulation.reference_sensor import PaperReference, ReferenceSensor
from torchcover.simulation.regions_of_interest import QueryPlan, RegionsOfInterest
from torchcover.simulation.rig import Rig, is_roadside, set_ego
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.scene_snapshot import SensorScan
from torchcover.simulation.simulator import Observation, Simulator
from torchcover.simulation.surface_reference import SurfaceReference

DEFAULT_REFERENCE = "surface"


class SimulatedFrames(FrameDataset):
    """Sensor and reference points of rigs in a scenario, frame by frame. A map-style torch Dataset.

    A frame depends only on the scenario, the rig, the seed and its index, not on workers, threads or the order of
    access. Rays are cast on as many threads as torch uses (`torch.set_num_threads`; one in a DataLoader worker). Points
    on the ego vehicle are in neither cloud; `Frame.counts` has the number of their rays.

    With `rigs`, the reference points are computed once per frame and all rigs observe the same scene, so that their
    differences are paired.

    Args:
        scenario: Scenario, name of a built-in one, or path of a YAML file.
        rig: Rig, name of a built-in one, or path of a YAML file.
        rigs: Several rigs by the name that `Frame.clouds` uses, in place of `rig`; `{}` for the reference alone.
        num_frames: Number of frames. Beyond the end of a scenario, procedural traffic starts again with other random
            numbers; other scenarios repeat, see `Frame.block_index` and `Frame.counts`.
        seed: Seed of traffic, reference sensor and sensor noise.
        reference_sensor: Reference sensor, such as `PaperReference()`. None for a `SurfaceReference` over the default
            regions: that of `create_reference_sensor`, or with boxes that of `create_object_reference`, which takes up
            to twice the time.
        frame_interval_s: Time between two frames, a multiple of the time step of the scenario; None for one time step.
            Consecutive time steps are correlated: a longer interval covers more of the scenario with as many frames.
        boxes: True if frames have `boxes`: one for each object in range of the reference, with the number of points of
            each rig and of the reference on it. Names of objects are unique within a run of the scenario.
        vehicle: Vehicle that carries the rigs: built-in name, YAML file, or mesh file. None for the ego vehicle of the
            scenario, else the vehicle that the rigs name, else an SUV.
        max_cached_bytes, no_cache, device: See `Simulator`.
        search_radius_m: See `Simulator`: clouds then contain hardly more than the points close to the reference.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: An invalid document, neither or both of `rig` and `rigs`, rigs that name different vehicles in a
            scenario without one, fewer than one frame, a negative seed, or an interval that is no multiple of the time
            step. When indexing: a sensor inside a body or below the ground, an actor that overlaps the ego vehicle.

    Example:
        >>> frames = SimulatedFrames("courtyard", "front_roof_128", num_frames=2, seed=0)
        >>> len(frames), frames[0].sensor.shape[1], frames[0].reference.dtype, frames.metadata.has_area_weights
        (2, 3, torch.float32, True)
    """

    def __init__(
        self,
        scenario: Scenario | str | Path,
        rig: Rig | str | Path | None = None,
        *,
        rigs: Mapping[str, Rig | str | Path] | None = None,
        num_frames: int,
        seed: int = 0,
        reference_sensor: ReferenceSensor | None = None,
        frame_interval_s: float | None = None,
        boxes: bool = False,
        vehicle: str | Path | None = None,
        max_cached_bytes: float | None = None,
        search_radius_m: float | None = None,
        no_cache: bool = False,
        device: str | None = None,
    ) -> None:
        max_frames = 1_000_000_000  # more would take years
        if not 1 <= num_frames <= max_frames:
            raise ValueError(f"num_frames: a number from 1 to {max_frames:,} is needed; got {num_frames}")
        rigs_by_name = _load_rigs(rig, rigs)
        scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        scenario = set_ego(scenario, rigs_by_name, vehicle)
        if reference_sensor is None:
            plan = RegionsOfInterest().build_query_plan(scenario.compute_ego_box().outline_m)
            reference_sensor = create_object_reference(plan) if boxes else create_reference_sensor(query_plan=plan)
        self.simulator = Simulator(
            scenario,
            rigs_by_name,
            _fit_to_rigs(reference_sensor, rigs_by_name, scenario),
            seed=seed,
            frame_interval_s=frame_interval_s,
            max_cached_bytes=max_cached_bytes,
            search_radius_m=search_radius_m,
            no_cache=no_cache,
            device=device,
        )
        self.num_frames = num_frames
        self.boxes = boxes

    @property
    def scenario(self) -> Scenario:
        """Scenario with its ego vehicle."""
        return self.simulator.scenario

    @property
    def rigs(self) -> Mapping[str, Rig]:
        """Rigs by the name that `Frame.clouds` uses."""
        return self.simulator.rigs

    @property
    def reference_sensor(self) -> ReferenceSensor:
        """Reference sensor, fitted to the rigs."""
        return self.simulator.reference_sensor

    @property
    def seed(self) -> int:
        """Seed of traffic, reference sensor and sensor noise."""
        return self.simulator.seed

    @property
    def frame_interval_s(self) -> float:
        """Time between two frames."""
        return self.simulator.frame_interval_s

    @property
    def metadata(self) -> FrameMetadata:
        """Rigs and their sensors, ego vehicle, and for `summary.json` scenario, sensor models, weather and seed."""
        rigs, scenario = self.rigs, self.scenario
        return FrameMetadata(
            rigs=tuple(rigs),
            description={
                "scenario": scenario.name,
                "vehicle": scenario.ego_name,
                "sensor_model": {name: rig.sensor_model for name, rig in rigs.items()},
                "weather": {name: (rig.weather or scenario.weather).name for name, rig in rigs.items()},
                "frames": None,
                "seed": self.seed,
            },
            has_area_weights=self.reference_sensor.has_area_weights,
            has_boxes=self.boxes,
            sensors={name: rig.sensors for name, rig in rigs.items()},
            sensor_names={name: rig.sensor_names for name, rig in rigs.items()},
            ego_outline_m=scenario.compute_ego_box().outline_m,
            ego_mesh=scenario.build_ego_mesh(),
        )

    def get_scene_id(self, index: int) -> int:
        """Get the scene of a frame; the index itself if the scenario repeats, since every process holds that scene.

        Args:
            index: Index of the frame.
        """
        return index if self.scenario.is_repeating else self.simulator.get_run_index(index)

    def get_block_index(self, index: int) -> int:
        """Get the block of a frame, see `Simulator.get_block_index`.

        Args:
            index: Index of the frame.
        """
        return self.simulator.get_block_index(index)

    def has_heights(self) -> bool:
        """Return True if reference points have heights above the local ground."""
        return self.reference_sensor.band_frame == "ground"

    def describe_reference(self) -> Mapping[str, object]:
        """Describe the reference sensor, with frame interval and notes on ground, traffic and self hits."""
        traffic, ego_mesh = self.scenario.traffic, self.scenario.build_ego_mesh()
        notes = [self.simulator.ground_note, traffic.sampling_note if traffic else ""]
        if getattr(self.reference_sensor, "is_over_areas", False):
            notes.append("Reference positions: anywhere in the regions, for the rig is on a mast and not on a vehicle.")
        for name, rig in self.rigs.items():
            self_hits = describe_self_hits(rig.sensors, rig.build_occluder_mesh(ego_mesh))
            notes.append(f"{name}: {self_hits}" if self_hits and len(self.rigs) > 1 else self_hits)
        return {
            "sensor": self.reference_sensor.name,
            "frame_interval_s": self.frame_interval_s,
            "notes": [note for note in notes if note],
        }

    def collect_content(self) -> Mapping[str, object]:
        """Collect the content of all documents and of the files that they name, and the settings.

        Raises:
            FileNotFoundError: A file is missing.
        """
        sensor = self.reference_sensor
        pattern = repr(sensor) if is_dataclass(sensor) else hashlib.sha256(pickle.dumps(sensor)).hexdigest()
        return {
            "scenario": self.scenario.collect_content(),
            **{f"rig {name}": rig.collect_content() for name, rig in self.rigs.items()},
            "reference sensor": pattern,
            "seed": self.seed,
            "frame_interval_s": self.frame_interval_s,
            "boxes": self.boxes,
            "search_radius_m": self.simulator.search_radius_m,
        }

    def replace_reference_sensor(self, reference_sensor: ReferenceSensor) -> Self:
        """Copy the frames with another reference sensor; both share the geometry of the scenes.

        Args:
            reference_sensor: Reference sensor.

        Raises:
            ValueError: The sensor cannot be used for a roadside rig.
        """
        fitted_sensor = _fit_to_rigs(reference_sensor, self.rigs, self.scenario)
        frames = copy.copy(self)
        frames.simulator = self.simulator.replace_reference_sensor(fitted_sensor)
        return frames

    def __len__(self) -> int:
        return self.num_frames

    def make_frame(self, index: int) -> Frame:
        """Simulate one frame."""
        return self.build_frame(self.simulator.simulate_frame(index), index)

    def build_frame(self, observation: Observation, index: int) -> Frame:
        """Build the frame of an observation.

        Args:
            observation: Result of the simulator.
            index: Index of the frame.
        """
        weights, heights_m = observation.reference_weights, observation.reference_heights_m
        frame = Frame(
            **build_rig_fields(self.rigs, observation.scans),
            reference=torch.from_numpy(observation.reference),
            reference_weights=None if weights is None else torch.from_numpy(weights),
            reference_heights_m=None if heights_m is None else torch.from_numpy(heights_m),
            index=index,
            name=f"{self.scenario.name} step {index}",
            counts=observation.counts,
            block_index=self.simulator.get_block_index(index),
        )
        return add_boxes(frame, self._build_boxes(index, observation), self.rigs) if self.boxes else frame

    def _build_boxes(self, index: int, observation: Observation) -> Boxes:
        """Build the boxes of all objects in range of the reference sensor."""
        labels = self.simulator.compute_labels(index)
        rows = [[*label.center_m, *label.size_m, label.yaw_rad] for label in labels]
        velocities = np.array([label.velocity_mps for label in labels])
        counts, object_indices = observation.sampled_point_counts, [label.object_index for label in labels]
        return Boxes.from_rows(
            torch.tensor(rows, dtype=torch.float32, device="cpu").view(-1, 7),
            velocity_mps=torch.tensor(velocities, dtype=torch.float32, device="cpu").view(-1, 2),
            ids=tuple(label.name for label in labels),
            categories=tuple(label.category for label in labels),
            sampled_points=None if counts is None else torch.from_numpy(counts[object_indices]),
            bottom_heights_m=torch.from_numpy(self.simulator.compute_bottom_heights_m(index, labels)),
        )


def _fit_to_rigs(sensor: ReferenceSensor, rigs: Mapping[str, Rig], scenario: Scenario) -> ReferenceSensor:
    """Extend the reference sensor to positions over all regions if a rig is on a mast at the roadside."""
    if not is_roadside(rigs.values(), scenario.compute_ego_box()):
        return sensor
    if isinstance(sensor, PaperReference):
        raise ValueError(
            "reference paper: its positions are close to the mast of this roadside rig, so that common blind spots "
            "are in no number; use the reference surface, whose positions are then anywhere in the regions"
        )
    return sensor.extend_to_areas() if isinstance(sensor, SurfaceReference) else sensor


def build_rig_fields(rigs: Mapping[str, Rig], scans: Mapping[str, Sequence[SensorScan]]) -> dict[str, Any]:
    """Build the fields of a `Frame` that concern its rigs: clouds, measurements and point counts per sensor.

    Args:
        rigs: Rigs by name.
        scans: Scans of the sensors of each rig, in the order of its sensors.
    """
    clouds: dict[str, Tensor] = {}
    measurements: dict[str, Measurement] = {}
    point_counts: dict[str, dict[str, int]] = {}
    for name, rig_scans in scans.items():
        clouds[name] = torch.from_numpy(np.concatenate([scan.points for scan in rig_scans]))
        sensor_names = rigs[name].sensor_names
        point_counts[name] = dict(zip(sensor_names, [len(scan.points) for scan in rig_scans], strict=True))
        if any(scan.measured_points is not None for scan in rig_scans):
            points, errors_m = [], []
            for scan in rig_scans:
                no_errors_m = np.zeros(len(scan.points), dtype=np.float32)
                points.append(scan.points if scan.measured_points is None else scan.measured_points)
                errors_m.append(no_errors_m if scan.range_error_m is None else scan.range_error_m)
            measured_points = torch.from_numpy(np.concatenate(points))
            measurements[name] = Measurement(measured_points, torch.from_numpy(np.concatenate(errors_m)))
    return {"clouds": clouds, "measurements": measurements, "sensor_point_counts": point_counts}


def add_boxes(frame: Frame, boxes: Boxes, rigs: Mapping[str, Rig]) -> Frame:
    """Add boxes to a frame, with the number of points of each rig in each box.

    Args:
        frame: Frame with the clouds of the rigs.
        boxes: Boxes of the frame.
        rigs: Rigs by name.
    """
    clouds = {name: frame.get_cloud(name, max_error_m=MEASURED_WITHIN_M) for name in frame.clouds}
    multiplicities = {}
    for name, rig in rigs.items():
        if any(sensor.pixels_per_sample > 1 for sensor in rig.sensors):
            sensor_clouds = frame.get_clouds_by_sensor(name, max_error_m=MEASURED_WITHIN_M).values()
            pixels_per_sample = torch.tensor([sensor.pixels_per_sample for sensor in rig.sensors], device="cpu")
            num_points = torch.tensor([len(cloud) for cloud in sensor_clouds], device="cpu")
            multiplicities[name] = pixels_per_sample.repeat_interleave(num_points)
    return replace(frame, boxes=add_point_counts(boxes, clouds, multiplicities))


def create_reference_sensor(
    name: str | None = None, num_rays: int | None = None, query_plan: QueryPlan | None = None
) -> ReferenceSensor:
    """Create a reference sensor for a query plan.

    Args:
        name: Name in `torchcover.simulation.REFERENCE_SENSORS`; None for "surface".
        num_rays: Approximate number of rays per frame; None for the default of the sensor.
        query_plan: Result of `RegionsOfInterest.build_query_plan`; None for the default regions of `evaluate`
            without the near field, since the vehicle is unknown.

    Raises:
        ValueError: Another name, or too few rays.

    Example:
        >>> sensor = create_reference_sensor()
        >>> sensor.name, sensor.num_rays, sensor.has_area_weights
        ('surface', 16384, True)
    """
    kind = REFERENCE_SENSORS.get(DEFAULT_REFERENCE if name is None else name)
    if kind is None:
        raise ValueError(f"reference {name}: {' or '.join(f'`{key}`' for key in REFERENCE_SENSORS)} is needed")
    return kind.from_query_plan(query_plan or RegionsOfInterest().build_query_plan(), num_rays)


def create_object_reference(query_plan: QueryPlan | None = None) -> SurfaceReference:
    """Create the default reference sensor with 64 additional points on each object in range, to measure its visibility.

    With 64 points, of which half are visible, the standard error of the visibility is at most 0.09.

    Args:
        query_plan: See `create_reference_sensor`.

    Example:
        >>> create_object_reference().points_per_object
        64
    """
    plan = query_plan or RegionsOfInterest().build_query_plan()
    return replace(SurfaceReference.from_query_plan(plan, None), points_per_object=64)


def _load_rigs(rig: Rig | str | Path | None, rigs: Mapping[str, Rig | str | Path] | None) -> dict[str, Rig]:
    """Load one rig or several rigs by name."""
    if (rig is None) == (rigs is None):
        raise ValueError("one rig is needed, or several as rigs={name: rig}")
    if rig is not None:
        rig = rig if isinstance(rig, Rig) else Rig.load(rig)
        return {rig.name: rig}
    rigs_by_name: dict[str, Rig] = {}
    for name, rig_or_path in (rigs or {}).items():
        rigs_by_name[name] = rig_or_path if isinstance(rig_or_path, Rig) else Rig.load(rig_or_path)
    return rigs_by_name
