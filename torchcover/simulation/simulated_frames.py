"""Frames of a simulated world, and the reference sensor that a rig is measured against in it."""

import copy
import hashlib
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch

from torchcover.coverage.quantities import MEASURED_WITHIN_M
from torchcover.detection.boxes import Boxes
from torchcover.detection.inside import add_point_counts
from torchcover.frames.frame import Frame, Measurement
from torchcover.frames.source import FrameDataset
from torchcover.geometry.arrays import Float32, Float64, Int64
from torchcover.simulation.instant import SensorScan
from torchcover.simulation.kinds import REFERENCE_SENSORS
from torchcover.simulation.reference_sensor import PaperReference, ReferenceSensor
from torchcover.simulation.regions_of_interest import QueryPlan, RegionsOfInterest
from torchcover.simulation.rig import Rig, is_roadside, set_ego
from torchcover.simulation.scenario import Scenario
from torchcover.simulation.sensor import Sensor
from torchcover.simulation.shapes import Mesh
from torchcover.simulation.sight import describe_self_hits
from torchcover.simulation.simulator import Observation, Simulator
from torchcover.simulation.surface_reference import SurfaceReference

DEFAULT_REFERENCE = "surface"
# With so many points on an object, of which half are seen, its visibility has a standard error of 0.09 at most.
OBJECT_POINTS = 64
# What takes years.
MAX_STEPS = 1_000_000_000


class SimulatedFrames(FrameDataset):
    """What a rig and the random reference sensor see of a scenario, step by step. A map-style torch Dataset.

    A frame depends on the scenario, the rig, the seed and its index, and on nothing else: not on workers, threads or
    the order of access. Frames are cast on as many threads as torch uses (`torch.set_num_threads`; one in a
    DataLoader worker). The points of the ego itself are in neither cloud; `Frame.counts` says how many rays they took.

    With `rigs` the reference is cast once a step, and every rig sees the same instant: comparisons are paired.

    Args:
        scenario: The world, the name of a built-in one, or the path of a YAML file.
        rig: The sensors, the name of a built-in rig, or the path of a YAML file.
        rigs: Several rigs instead, by the name under which `Frame.clouds` has their clouds; `{}`: the reference alone.
        num_frames: Number of frames. Beyond the end of a scenario its traffic starts anew with other random numbers; without
            traffic, the same instants are seen again, which `Frame.block_index` and `Frame.counts` say.
        seed: Seed of the traffic and of the reference sensor's poses.
        reference_sensor: The reference sensor, such as `PaperReference()`. If not given, a `SurfaceReference` that is
            aimed at the usual regions: `create_reference_sensor`, and `create_object_reference` with boxes, at up to twice the
            time.
        frame_interval_s: Time between one frame and the next, a multiple of the scenario's time step; that step if not given.
            Steps that follow each other are alike: with the same number of frames, a longer time shows more, and in
            traffic, which starts anew, the frames are spread over more cities.
        boxes: Whether frames have `boxes`: one for each object within the reference's range, with how many points each
            rig has in it, and how many the reference drew on it. An object's name is its own within a run of the
            scenario.
        vehicle: What carries the rigs: a built-in vehicle, the YAML file of one, or a mesh file. Not given: the
            scenario's own ego, else the vehicle that the rigs name, else an SUV.
        max_cached_bytes: As in `Simulator`.
        within_m: As in `Simulator`: the clouds have the points near the reference, and hardly any others.
        no_cache: As in `Simulator`.
        device: As in `Simulator`.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A document that is not valid, neither or both of `rig` and `rigs`, rigs that name different vehicles
            in a scenario that leaves it to them, a number of steps below 1, a negative seed, a time that is no multiple
            of the time step. From indexing: a sensor inside a body or below the ground, an actor that overlaps the ego.

    Example:
        >>> frames = SimulatedFrames("courtyard", "front_roof_128", steps=2, seed=0)
        >>> len(frames), frames[0].sensor.shape[1], frames[0].reference.dtype, frames.square_metres
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
        if not 1 <= num_frames <= MAX_STEPS:
            raise ValueError(f"steps: a number from 1 to {MAX_STEPS:,} is needed; got {num_frames}")
        carried = _rigs(rig, rigs)
        world = set_ego(scenario if isinstance(scenario, Scenario) else Scenario.load(scenario), carried, vehicle)
        if reference_sensor is None:
            asked = RegionsOfInterest().build_query_plan(world.compute_ego_box().outline_m)
            reference_sensor = create_object_reference(asked) if boxes else create_reference_sensor(query_plan=asked)
        self.simulator = Simulator(
            world,
            carried,
            _fit_to_rigs(reference_sensor, carried, world),
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
        """The world."""
        return self.simulator.scenario

    @property
    def rigs(self) -> Mapping[str, Rig]:
        """The sensors, by the name under which `Frame.clouds` has their clouds."""
        return self.simulator.rigs

    @property
    def reference_sensor(self) -> ReferenceSensor:
        """The reference sensor."""
        return self.simulator.reference_sensor

    @property
    def seed(self) -> int:
        """Seed of the traffic and of the reference sensor's poses."""
        return self.simulator.seed

    @property
    def frame_interval_s(self) -> float:
        """Time between one frame and the next."""
        return self.simulator.frame_interval_s

    @property
    def sensors(self) -> Mapping[str, Sequence[Sensor]]:
        """The sensors of each rig."""
        return {name: rig.sensors for name, rig in self.rigs.items()}

    @property
    def sensor_names(self) -> Mapping[str, Sequence[str]]:
        """The names of the sensors of each rig."""
        return {name: [sensor.name for sensor in rig.sensors] for name, rig in self.rigs.items()}

    def get_scene_id(self, index: int) -> int:
        """Which world a frame is of; of one that plays again and again every process has it whole: the index."""
        return index if self.scenario.is_repeating else self.simulator.get_run_index(index)

    def get_block_index(self, index: int) -> int:
        """As `Simulator.block_index`."""
        return self.simulator.get_block_index(index)

    def has_boxes(self) -> bool:
        """Whether they were asked for."""
        return self.boxes

    def has_heights(self) -> bool:
        """Whether the reference sensor finds them."""
        return self.reference_sensor.band_frame == "ground"

    def get_ego_mesh(self) -> Mesh:
        """What carries the rigs, in the vehicle frame; no world is built for it."""
        return self.scenario.build_ego_mesh()

    @property
    def ego_outline_m(self) -> Float64:
        """(4, 2) corners x, y of the ego as seen from above, counter-clockwise; no world is built for it."""
        return self.scenario.compute_ego_box().outline_m

    @property
    def description(self) -> Mapping[str, object]:
        """The names of the scenario and of the vehicle, what sensors make of their hits, and the seed."""
        return {
            "scenario": self.scenario.name,
            "vehicle": self.scenario.ego_name,
            "sensor_model": {name: rig.sensor_model for name, rig in self.rigs.items()},
            "weather": {name: (rig.weather or self.scenario.weather).name for name, rig in self.rigs.items()},
            "frames": None,
            "seed": self.seed,
        }

    @property
    def has_area_weights(self) -> bool:
        """Whether the reference sensor gives the square metres of its points."""
        return self.reference_sensor.has_area_weights

    @property
    def reference_record(self) -> Mapping[str, object]:
        """The reference sensor, the time between two frames; notes on ground, traffic and rays that the ego ends."""
        traffic, ego = self.scenario.traffic, self.get_ego_mesh()
        words = [self.simulator.ground_note, traffic.sampling_note if traffic else ""]
        if getattr(self.reference_sensor, "is_over_areas", False):
            words.append("Reference positions: anywhere in the regions, for the rig is on a mast and not on a vehicle.")
        for name, rig in self.rigs.items():
            self_hits = describe_self_hits(rig.sensors, rig.build_occluder_mesh(ego))
            words.append(f"{name}: {self_hits}" if self_hits and len(self.rigs) > 1 else self_hits)
        return {
            "sensor": self.reference_sensor.name,
            "frame_interval_s": self.frame_interval_s,
            "notes": list(filter(None, words)),
        }

    @property
    def content(self) -> Mapping[str, object]:
        """What stands in the documents and in the files that they name, and the settings.

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
        """The same instants as another reference sensor sees them; the geometry is built once for both."""
        other = copy.copy(self)
        fitted = _fit_to_rigs(reference_sensor, self.rigs, self.scenario)
        other.simulator = self.simulator.replace_reference_sensor(fitted)
        return other

    def __len__(self) -> int:
        return self.num_frames

    def _frame_at(self, position: int) -> Frame:
        return self.build_frame(self.simulator.simulate_frame(position), position)

    def build_frame(self, observation: Observation, index: int) -> Frame:
        """The frame of what the simulator saw at a step."""
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
        return (
            add_boxes(frame, self._boxes(index, observation.sampled_point_counts), self.rigs) if self.boxes else frame
        )

    def _boxes(self, index: int, drawn: Int64 | None) -> Boxes:
        found = self.simulator.compute_labels(index)
        rows = [[*label.center_m, *label.size_m, label.yaw_rad] for label in found]
        velocities = np.array([label.velocity_mps for label in found])
        return Boxes.from_rows(
            torch.tensor(rows, dtype=torch.float32, device="cpu").view(-1, 7),
            velocity_mps=torch.tensor(velocities, dtype=torch.float32, device="cpu").view(-1, 2),
            ids=tuple(label.name for label in found),
            categories=tuple(label.category for label in found),
            sampled_points=None if drawn is None else torch.from_numpy(drawn[[label.object_index for label in found]]),
            bottom_heights_m=torch.from_numpy(self.simulator.compute_bottom_heights_m(index, found)),
        )


def _fit_to_rigs(sensor: ReferenceSensor, rigs: Mapping[str, Rig], scenario: Scenario) -> ReferenceSensor:
    """The reference sensor, with positions over all regions if a rig is on a mast beside the road."""
    if not is_roadside(rigs.values(), scenario.compute_ego_box()):
        return sensor
    if isinstance(sensor, PaperReference):
        raise ValueError(
            "reference paper: it looks from the mast of this roadside rig, so that what is hidden from both is in no "
            "number; use the reference surface, which looks from anywhere in the regions then"
        )
    return sensor.extend_to_areas() if isinstance(sensor, SurfaceReference) else sensor


def build_rig_fields(rigs: Mapping[str, Rig], scans: Mapping[str, Sequence[SensorScan]]) -> dict[str, Any]:
    """What a `Frame` says of its rigs: clouds, what was measured of them, and which points are of which sensor."""
    clouds = {name: torch.from_numpy(np.concatenate([one.points for one in seen])) for name, seen in scans.items()}
    measured = {
        name: Measurement(
            torch.from_numpy(
                np.concatenate([one.points if one.measured_points is None else one.measured_points for one in seen])
            ),
            torch.from_numpy(np.concatenate([_error_m(one) for one in seen])),
        )
        for name, seen in scans.items()
        if any(one.measured_points is not None for one in seen)
    }
    points = {
        name: {sensor.name: len(one.points) for sensor, one in zip(rigs[name].sensors, seen, strict=True)}
        for name, seen in scans.items()
    }
    return {"clouds": clouds, "measurements": measured, "sensor_point_counts": points}


def add_boxes(frame: Frame, boxes: Boxes, rigs: Mapping[str, Rig]) -> Frame:
    """The frame with its objects, and how many points each of its rigs has on them."""
    clouds = {name: frame.get_cloud(name, max_error_m=MEASURED_WITHIN_M) for name in frame.clouds}
    counts_as = {}
    for name, rig in rigs.items():
        if any(sensor.pixels_per_sample > 1 for sensor in rig.sensors):
            of_sensors = frame.get_clouds_by_sensor(name, max_error_m=MEASURED_WITHIN_M).values()
            each = torch.tensor([sensor.pixels_per_sample for sensor in rig.sensors], device="cpu")
            counts_as[name] = each.repeat_interleave(torch.tensor([len(cloud) for cloud in of_sensors], device="cpu"))
    return replace(frame, boxes=add_point_counts(boxes, clouds, counts_as))


def _error_m(scan: SensorScan) -> Float32:
    return np.zeros(len(scan.points), dtype=np.float32) if scan.range_error_m is None else scan.range_error_m


def create_reference_sensor(
    name: str | None = None, num_rays: int | None = None, query_plan: QueryPlan | None = None
) -> ReferenceSensor:
    """A reference sensor by its name, aimed at what is asked about.

    Args:
        name: One of `torchcover.simulation.REFERENCE_SENSORS`; "surface" if not given.
        num_rays: About how many rays at each step; the sensor's own number if not given.
        query_plan: Regions, height bands and grid, as `RegionsOfInterest.around` gives them; those of `torchcover.evaluate`
            without the near field, for the vehicle is unknown, if not given.

    Raises:
        ValueError: Another name, or too few rays.

    Example:
        >>> sensor = create_reference_sensor()
        >>> sensor.name, sensor.rays, sensor.square_metres
        ('surface', 16384, True)
    """
    kind = REFERENCE_SENSORS.get(DEFAULT_REFERENCE if name is None else name)
    if kind is None:
        raise ValueError(f"reference {name}: {' or '.join(f'`{known}`' for known in REFERENCE_SENSORS)} is needed")
    return kind.from_query_plan(query_plan or RegionsOfInterest().build_query_plan(), num_rays)


def create_object_reference(query_plan: QueryPlan | None = None) -> SurfaceReference:
    """The default reference sensor with 64 points for each object in range: one that knows how visible they are.

    `query_plan` is as in `create_reference_sensor`.

    Example:
        >>> create_object_reference().object_points
        64
    """
    return replace(
        SurfaceReference.from_query_plan(query_plan or RegionsOfInterest().build_query_plan(), None),
        points_per_object=OBJECT_POINTS,
    )


def _rigs(rig: Rig | str | Path | None, rigs: Mapping[str, Rig | str | Path] | None) -> dict[str, Rig]:
    if (rig is None) == (rigs is None):
        raise ValueError("give one rig, or several as rigs={name: rig}")
    if rig is not None:
        only = _load(rig)
        return {only.name: only}
    return {name: _load(given) for name, given in (rigs or {}).items()}


def _load(rig: Rig | str | Path) -> Rig:
    return rig if isinstance(rig, Rig) else Rig.load(rig)
