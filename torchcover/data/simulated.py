"""Frames of a simulated world."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from torchcover.data.frame import Frame
from torchcover.simulation import ReferenceSensor, Rig, Scenario
from torchcover.simulation.rays import Tile, into_tiles
from torchcover.simulation.scene import Instant, Scan, Scene


class SimulatedFrames(Dataset[Frame]):
    """What a rig and the random reference sensor see of a scenario, step by step. A map-style torch Dataset.

    A frame depends on the scenario, the rig, the seed and its index, and on nothing else: not on workers, threads or
    the order of access. Frames are cast on as many threads as torch uses (`torch.set_num_threads`; one in a
    DataLoader worker). The points of the ego itself are in neither cloud; `Frame.counts` says how many rays they took.

    Args:
        scenario: The world, the name of a built-in one, or the path of a YAML file.
        rig: The sensors, the name of a built-in rig, or the path of a YAML file.
        steps: Number of frames.
        seed: Seed of the reference sensor's poses.
        reference: The reference sensor; the paper's if not given.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A document that is not valid, a number of steps below 1, a negative seed.

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
        rig: Rig | str | Path,
        *,
        steps: int,
        seed: int = 0,
        reference: ReferenceSensor | None = None,
    ) -> None:
        if steps < 1:
            raise ValueError(f"steps: at least 1 is needed; got {steps}")
        if seed < 0:
            raise ValueError(f"seed: a number >= 0 is needed; got {seed}")
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        self.rig = rig if isinstance(rig, Rig) else Rig.load(rig)
        self.steps = steps
        self.seed = seed
        self.reference = reference or ReferenceSensor()
        self._scene: Scene | None = None
        self._reference_tiles: tuple[Tile, ...] = ()
        self._sensor_tiles: list[tuple[Tile, ...]] = []

    @property
    def scene(self) -> Scene:
        """The scenario as geometry; built when first needed, once in each process."""
        if self._scene is None:
            self._scene = Scene(self.scenario.world())
            self._reference_tiles = into_tiles(self.reference.directions())
            self._sensor_tiles = [into_tiles(sensor.directions()) for sensor in self.rig.sensors]
        return self._scene

    def __len__(self) -> int:
        return self.steps

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < self.steps:
            raise IndexError(f"frame {index} of {self.steps}")
        instant = self.scene.at(0)
        sensor_scans = self._scan_sensors(instant)
        reference_scan = self._scan_reference(instant, index)
        points = np.concatenate([scan.points for scan in sensor_scans])
        return Frame(
            sensor=torch.from_numpy(points),
            reference=torch.from_numpy(reference_scan.points),
            index=index,
            name=f"{self.scenario.name} step {index}",
            counts=_count("sensor", sensor_scans) | _count("reference", [reference_scan]),
        )

    def _scan_sensors(self, instant: Instant) -> list[Scan]:
        return [
            instant.scan(
                sensor.mount.matrix(),
                tiles,
                min_range_m=sensor.min_range_m,
                max_range_m=sensor.max_range_m,
                threads=torch.get_num_threads(),
            )
            for sensor, tiles in zip(self.rig.sensors, self._sensor_tiles, strict=True)
        ]

    def _scan_reference(self, instant: Instant, index: int) -> Scan:
        generator = np.random.default_rng([self.seed, index])
        vehicle_T_reference = self.reference.vehicle_T_reference(self.scene.ego_box, generator)
        return instant.scan(
            vehicle_T_reference,
            self._reference_tiles,
            max_range_m=self.reference.max_range_m,
            threads=torch.get_num_threads(),
        )

    def __getstate__(self) -> dict[str, Any]:
        # Embree's scene cannot be pickled; a worker builds its own.
        return {**self.__dict__, "_scene": None, "_reference_tiles": (), "_sensor_tiles": []}


def _count(source: str, scans: list[Scan]) -> dict[str, int]:
    return {
        f"{source}_rays": sum(scan.rays for scan in scans),
        f"{source}_self_hits": sum(scan.self_hits for scan in scans),
    }
