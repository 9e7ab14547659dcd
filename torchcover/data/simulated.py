"""Frames of a simulated world."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from torchcover.data.frame import Frame
from torchcover.detection.boxes import Boxes, points_in_boxes
from torchcover.geometry import BoundingBox
from torchcover.geometry.rigid import Matrix
from torchcover.simulation import EvenReference, PaperReference, Rig, Scenario
from torchcover.simulation.bodies import VehicleShape, mover_mesh
from torchcover.simulation.disturbance import disturb
from torchcover.simulation.instant import Instant, Scan
from torchcover.simulation.labels import Label, labels
from torchcover.simulation.mounted import MountedSensor
from torchcover.simulation.rays import Tile, into_tiles
from torchcover.simulation.rig import Sensor
from torchcover.simulation.scene import Scene

# A reference pose inside a body is drawn again, at most this often.
MAX_DRAWS = 100


class SimulatedFrames(Dataset[Frame]):
    """What a rig and the random reference sensor see of a scenario, step by step. A map-style torch Dataset.

    A frame depends on the scenario, the rig, the seed and its index, and on nothing else: not on workers, threads or
    the order of access. Frames are cast on as many threads as torch uses (`torch.set_num_threads`; one in a
    DataLoader worker). The points of the ego itself are in neither cloud; `Frame.counts` says how many rays they took.

    With `rigs` the reference is cast once a step, and every rig sees the same instant: comparisons are paired.

    Args:
        scenario: The world, the name of a built-in one, or the path of a YAML file.
        rig: The sensors, the name of a built-in rig, or the path of a YAML file.
        rigs: Several rigs instead, by the name under which `Frame.clouds` has their clouds.
        steps: Number of frames. Beyond the end of a scenario its traffic starts anew with other random numbers.
        seed: Seed of the traffic and of the reference sensor's poses.
        reference_sensor: The reference sensor, the paper's or an even one; the paper's if not given.
        every_s: Time between one frame and the next, a multiple of the scenario's time step; that step if not given.
            Steps that follow each other are alike: with the same number of frames, a longer time shows more, and in
            traffic, which starts anew, the frames are spread over more cities.
        boxes: Whether frames have `boxes`: one for each object within the reference's range, with how many points each
            rig has in it. An object's name is its own within a run of the scenario.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A document that is not valid, neither or both of `rig` and `rigs`, a number of steps below 1, a
            negative seed, a time that is no multiple of the time step. From indexing: a sensor inside the ego's body,
            an actor that overlaps the ego.

    Example:
        >>> frames = SimulatedFrames(
        ...     "courtyard", "front_roof_128", steps=2, seed=0, reference_sensor=PaperReference(rows=16, columns=16)
        ... )
        >>> len(frames), frames[0].sensor.shape[1], frames[0].reference.dtype
        (2, 3, torch.float32)
    """

    def __init__(
        self,
        scenario: Scenario | str | Path,
        rig: Rig | str | Path | None = None,
        *,
        rigs: Mapping[str, Rig | str | Path] | None = None,
        steps: int,
        seed: int = 0,
        reference_sensor: PaperReference | EvenReference | None = None,
        every_s: float | None = None,
        boxes: bool = False,
    ) -> None:
        if (rig is None) == (not rigs):
            raise ValueError("give one rig, or several as rigs={name: rig}")
        if steps < 1:
            raise ValueError(f"steps: at least 1 is needed; got {steps}")
        if seed < 0:
            raise ValueError(f"seed: a number >= 0 is needed; got {seed}")
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        if rig is not None:
            only = _load(rig)
            self.rigs = {only.name: only}
        else:
            self.rigs = {name: _load(given) for name, given in (rigs or {}).items()}
        self.steps = steps
        self.seed = seed
        self.reference_sensor = reference_sensor or PaperReference()
        self._every_steps = 1 if every_s is None else self.scenario.steps_in(every_s)
        self.boxes = boxes
        # The geometry of one episode and the sensors in it, by its number.
        self._built: dict[int, tuple[Scene, dict[str, list[MountedSensor]]]] = {}
        self._rig_tiles: dict[str, list[tuple[Tile, ...]]] = {}

    @property
    def every_s(self) -> float:
        """Time between one frame and the next."""
        return self._every_steps * self.scenario.step_s

    @property
    def scene(self) -> Scene:
        """The geometry of the first frame's world; see `scene_of`."""
        return self.scene_of(0)[0]

    def scene_of(self, index: int) -> tuple[Scene, int]:
        """The geometry of a frame's world, and the frame's time step in it.

        It is built when first needed, once in each process for each run through the scenario.
        """
        scene, _, step = self._stage(index)
        return scene, step

    @property
    def sensors(self) -> Mapping[str, Sequence[Sensor]]:
        """The sensors of each rig."""
        return {name: rig.sensors for name, rig in self.rigs.items()}

    @property
    def ego_outline_m(self) -> NDArray[np.float64]:
        """(4, 2) corners x, y of the ego as seen from above, counter-clockwise; no world is built for it."""
        shape = self.scenario.ego.shape if self.scenario.ego else VehicleShape(type="vehicle", vehicle="suv")
        return BoundingBox.around(mover_mesh("ego", shape).vertices_m).outline_m

    @property
    def description(self) -> Mapping[str, object]:
        """The scenario's name and the seed."""
        return {"scenario": self.scenario.name, "frames": None, "seed": self.seed}

    @property
    def reference(self) -> Mapping[str, object]:
        """The pattern of the reference sensor and the time between two frames."""
        pattern = type(self.reference_sensor).__name__.removesuffix("Reference").lower()
        return {"sensor": pattern, "every_s": self.every_s}

    def with_reference_sensor(self, reference_sensor: PaperReference | EvenReference) -> "SimulatedFrames":
        """The same instants as another reference sensor sees them; the geometry is built once for both."""
        other = object.__new__(type(self))
        other.__dict__ |= self.__dict__  # copy.copy would leave the geometry behind, as pickling does
        other.reference_sensor = reference_sensor
        return other

    def _stage(self, index: int) -> tuple[Scene, Mapping[str, Sequence[MountedSensor]], int]:
        """The scene of a frame, the sensors of each rig in it, and the frame's time step."""
        episode, step = self.scenario.locate(index * self._every_steps)
        if not self._rig_tiles:
            self._rig_tiles = {
                name: [into_tiles(sensor.directions()) for sensor in rig.sensors] for name, rig in self.rigs.items()
            }
        if episode not in self._built:
            self._built.clear()
            scene = Scene(self.scenario.world(self.seed, episode))
            self._check_mounts(scene)
            self._built[episode] = scene, {name: self._mount(name, scene) for name in self.rigs}
        return *self._built[episode], step

    def _mount(self, name: str, scene: Scene) -> list[MountedSensor]:
        sensors = zip(self.rigs[name].sensors, self._rig_tiles[name], strict=True)
        return [MountedSensor(sensor, tiles, scene) for sensor, tiles in sensors]

    def _check_mounts(self, scene: Scene) -> None:
        for name, rig in self.rigs.items():
            for sensor in rig.sensors:
                place = sensor.mount.matrix()[:3, 3]
                if scene.encloses(place):
                    raise ValueError(
                        f"rig {name!r}: sensor {sensor.name!r} at {place.round(3).tolist()} m lies inside the ego of "
                        f"{self.scenario.name!r}, so that all its rays start blocked; move its mount"
                    )

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self.steps:
            raise IndexError(f"frame {index} of {self.steps}")
        scene, mounted, step = self._stage(index)
        instant = scene.at(step, within_m=self._reach_m(scene.ego_box))
        scans = {name: self._scan_rig(sensors, instant, index) for name, sensors in mounted.items()}
        reference, weights, redrawn = self._scan_reference(scene, instant, index)
        clouds = {name: torch.from_numpy(_fuse(rig_scans)) for name, rig_scans in scans.items()}
        return Frame(
            clouds=clouds,
            reference=torch.from_numpy(reference.points),
            reference_weights=None if weights is None else torch.from_numpy(weights),
            index=index,
            name=f"{self.scenario.name} step {index}",
            counts={
                **_count("sensor", [scan for rig_scans in scans.values() for scan in rig_scans]),
                **_count("reference", [reference]),
                "reference_poses_redrawn": redrawn,
                **_left_out(scene, instant, [scan for rig_scans in scans.values() for scan in rig_scans], reference),
            },
            boxes=_boxes(labels(scene.world, step, self.reference_sensor.max_range_m), clouds) if self.boxes else None,
        )

    def _reach_m(self, ego: BoundingBox) -> float:
        """How far from the origin of the vehicle frame a sensor can see: its range starts where it is mounted."""
        farthest_m = np.abs(ego.corners_m).max(axis=0) + self.reference_sensor.shell_m
        reaches = [
            float(np.linalg.norm(sensor.mount.matrix()[:3, 3])) + sensor.max_range_m
            for rig in self.rigs.values()
            for sensor in rig.sensors
        ]
        return max(float(np.linalg.norm(farthest_m)) + self.reference_sensor.max_range_m, *reaches)

    def _scan_rig(self, sensors: Sequence[MountedSensor], instant: Instant, index: int) -> list[Scan]:
        scans = []
        for k, mounted in enumerate(sensors, 1):
            scan = mounted.scan(instant, threads=torch.get_num_threads())
            generator = np.random.default_rng([self.seed, index, k])
            origin_m, sensor = mounted.vehicle_T_sensor[:3, 3], mounted.sensor
            scans.append(disturb(scan, origin_m, sensor.range_noise_m, sensor.dropout, generator))
        return scans

    def _scan_reference(
        self, scene: Scene, instant: Instant, index: int
    ) -> tuple[Scan, NDArray[np.float32] | None, int]:
        generator = np.random.default_rng([self.seed, index])
        vehicle_T_reference, redrawn = self._draw_reference_pose(scene, instant, index, generator)
        tiles = self.reference_sensor.tiles(vehicle_T_reference, generator)
        scan = instant.scan(
            vehicle_T_reference, tiles, max_range_m=self.reference_sensor.max_range_m, threads=torch.get_num_threads()
        )
        return scan, self.reference_sensor.weights(vehicle_T_reference, tiles, scan.ray), redrawn

    def _draw_reference_pose(
        self, scene: Scene, instant: Instant, index: int, generator: np.random.Generator
    ) -> tuple[Matrix, int]:
        for redrawn in range(MAX_DRAWS):
            vehicle_T_reference = self.reference_sensor.vehicle_T_reference(scene.ego_box, generator)
            if not instant.buried(vehicle_T_reference[:3, 3]):
                return vehicle_T_reference, redrawn
        raise ValueError(
            f"{self.scenario.name} step {index}: {MAX_DRAWS} places beside and above the ego lie inside other bodies "
            "or below the ground; does the ego stand on the ground, and do faces point outwards?"
        )

    def __getstate__(self) -> dict[str, Any]:
        # Embree's scene cannot be pickled; a worker builds its own.
        return {**self.__dict__, "_built": {}, "_rig_tiles": {}}


def _load(rig: Rig | str | Path) -> Rig:
    return rig if isinstance(rig, Rig) else Rig.load(rig)


def _boxes(found: Sequence[Label], clouds: Mapping[str, torch.Tensor]) -> Boxes:
    rows = [[*label.centre_m, *label.size_m, label.yaw_rad] for label in found]
    boxes = Boxes.from_rows(
        torch.tensor(rows, dtype=torch.float32).view(-1, 7),
        velocity_mps=torch.tensor(np.array([label.velocity_mps for label in found]), dtype=torch.float32).view(-1, 2),
        ids=tuple(label.name for label in found),
        categories=tuple(label.category for label in found),
    )
    inside = {name: points_in_boxes(cloud, boxes).box for name, cloud in clouds.items()}
    return replace(boxes, hits={name: torch.bincount(box, minlength=len(boxes)) for name, box in inside.items()})


def _fuse(scans: list[Scan]) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.concatenate([scan.points for scan in scans])


def _count(source: str, scans: list[Scan]) -> dict[str, int]:
    return {
        f"{source}_rays": sum(scan.rays for scan in scans),
        f"{source}_self_hits": sum(scan.self_hits for scan in scans),
    }


def _left_out(scene: Scene, instant: Instant, scans: Sequence[Scan], reference: Scan) -> dict[str, int]:
    """What this frame did not need, beside the number of all that there were of the kind."""
    rays = sum(scan.rays for scan in scans)
    pairs = (rays + reference.rays) * len(instant.moving)
    return {
        "moving_bodies": len(instant.moving) + instant.out_of_range,
        "moving_bodies_out_of_range": instant.out_of_range,
        "ray_body_pairs": pairs,
        "ray_body_pairs_left_out": pairs - reference.body_casts - sum(scan.body_casts for scan in scans),
        "sensor_rays_reused": 0 if scene.moves else rays,
        "sensor_self_hits_reused": sum(scan.self_hits for scan in scans) if scene.knows_self_hits else 0,
    }
