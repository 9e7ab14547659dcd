"""Frames of a simulated world."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from torchcover.data.frame import Frame
from torchcover.geometry.rigid import Matrix
from torchcover.simulation import ReferenceSensor, Rig, Scenario
from torchcover.simulation.disturbance import disturb
from torchcover.simulation.rays import Tile, into_tiles
from torchcover.simulation.scene import Instant, Scan, Scene

# A reference pose inside a body is drawn again, at most this often.
MOST_DRAWS = 100


class SimulatedFrames(Dataset[Frame]):
    """What a rig and the random reference sensor see of a scenario, step by step. A map-style torch Dataset.

    A frame depends on the scenario, the rig, the seed and its index, and on nothing else: not on workers, threads or
    the order of access. Frames are cast on as many threads as torch uses (`torch.set_num_threads`; one in a
    DataLoader worker). The points of the ego itself are in neither cloud; `Frame.counts` says how many rays they took.

    With `rigs` the reference is cast once a step, and every rig sees the same instant: comparisons are paired.

    Args:
        scenario: The world, the name of a built-in one, or the path of a YAML file.
        rig: The sensors, the name of a built-in rig, or the path of a YAML file.
        rigs: Several rigs instead, by the name under which `Frame.sensors` has their clouds.
        steps: Number of frames. Beyond the end of a scenario its traffic starts anew with other random numbers.
        seed: Seed of the traffic and of the reference sensor's poses.
        reference: The reference sensor; the paper's if not given.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A document that is not valid, neither or both of `rig` and `rigs`, a number of steps below 1, a
            negative seed. From indexing: a sensor inside the ego's body, an actor that overlaps the ego.

    Example:
        >>> frames = SimulatedFrames(
        ...     "courtyard", "front_roof_128", steps=2, seed=0, reference=ReferenceSensor(rows=16, columns=16)
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
        reference: ReferenceSensor | None = None,
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
        self.reference = reference or ReferenceSensor()
        self._forget()

    def _forget(self) -> None:
        self._scene: Scene | None = None
        self._episode = -1
        self._reference_tiles: tuple[Tile, ...] = ()
        self._rig_tiles: dict[str, list[tuple[Tile, ...]]] = {}

    @property
    def scene(self) -> Scene:
        """The geometry of the first frame's world; see `scene_of`."""
        return self.scene_of(0)[0]

    def scene_of(self, index: int) -> tuple[Scene, int]:
        """The geometry of a frame's world, and the frame's time step in it.

        It is built when first needed, once in each process for each run through the scenario.
        """
        episode, step = self.scenario.locate(index)
        if self._scene is None or episode != self._episode:
            self._scene, self._episode = Scene(self.scenario.world(self.seed, episode)), episode
            self._check_mounts(self._scene)
        if not self._reference_tiles:
            self._reference_tiles = into_tiles(self.reference.directions())
            self._rig_tiles = {
                name: [into_tiles(sensor.directions()) for sensor in rig.sensors] for name, rig in self.rigs.items()
            }
        return self._scene, step

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
        scene, step = self.scene_of(index)
        instant = scene.at(step, within_m=self._longest_range_m())
        scans = {name: self._scan_rig(instant, name, index) for name in self.rigs}
        reference, redrawn = self._scan_reference(scene, instant, index)
        return Frame(
            sensors={name: torch.from_numpy(_fuse(rig_scans)) for name, rig_scans in scans.items()},
            reference=torch.from_numpy(reference.points),
            index=index,
            name=f"{self.scenario.name} step {index}",
            counts={
                **_count("sensor", [scan for rig_scans in scans.values() for scan in rig_scans]),
                **_count("reference", [reference]),
                "reference_poses_redrawn": redrawn,
            },
        )

    def _longest_range_m(self) -> float:
        ranges = [sensor.max_range_m for rig in self.rigs.values() for sensor in rig.sensors]
        return max(self.reference.max_range_m, *ranges)

    def _scan_rig(self, instant: Instant, name: str, index: int) -> list[Scan]:
        scans = []
        for k, (sensor, tiles) in enumerate(zip(self.rigs[name].sensors, self._rig_tiles[name], strict=True), 1):
            vehicle_T_sensor = sensor.mount.matrix()
            scan = instant.scan(
                vehicle_T_sensor,
                tiles,
                min_range_m=sensor.min_range_m,
                max_range_m=sensor.max_range_m,
                threads=torch.get_num_threads(),
            )
            generator = np.random.default_rng([self.seed, index, k])
            points = disturb(scan.points, vehicle_T_sensor[:3, 3], sensor.range_noise_m, sensor.dropout, generator)
            scans.append(scan._replace(points=points))
        return scans

    def _scan_reference(self, scene: Scene, instant: Instant, index: int) -> tuple[Scan, int]:
        vehicle_T_reference, redrawn = self._draw_reference_pose(scene, instant, index)
        scan = instant.scan(
            vehicle_T_reference,
            self._reference_tiles,
            max_range_m=self.reference.max_range_m,
            threads=torch.get_num_threads(),
        )
        return scan, redrawn

    def _draw_reference_pose(self, scene: Scene, instant: Instant, index: int) -> tuple[Matrix, int]:
        generator = np.random.default_rng([self.seed, index])
        for redrawn in range(MOST_DRAWS):
            vehicle_T_reference = self.reference.vehicle_T_reference(scene.ego_box, generator)
            if not instant.buried(vehicle_T_reference[:3, 3]):
                return vehicle_T_reference, redrawn
        raise ValueError(
            f"{self.scenario.name} step {index}: {MOST_DRAWS} places beside and above the ego lie inside other bodies "
            "or below the ground; does the ego stand on the ground, and do faces point outwards?"
        )

    def __getstate__(self) -> dict[str, Any]:
        # Embree's scene cannot be pickled; a worker builds its own.
        return {**self.__dict__, "_scene": None, "_reference_tiles": (), "_rig_tiles": {}}


def _load(rig: Rig | str | Path) -> Rig:
    return rig if isinstance(rig, Rig) else Rig.load(rig)


def _fuse(scans: list[Scan]) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.concatenate([scan.points for scan in scans])


def _count(source: str, scans: list[Scan]) -> dict[str, int]:
    return {
        f"{source}_rays": sum(scan.rays for scan in scans),
        f"{source}_self_hits": sum(scan.self_hits for scan in scans),
    }
