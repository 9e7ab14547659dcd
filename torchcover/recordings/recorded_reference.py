"""The reference of a recording, where it was recorded."""

from collections.abc import Collection, Mapping
from typing import Protocol

from torchcover.recordings.in_vehicle import InVehicle, in_vehicle, joined
from torchcover.recordings.recording import Recording


class Reference(Protocol):
    """Where the reference clouds of a recording come from."""

    def check(self, recording: Recording, judged: Collection[str], /) -> None:
        """Whether a recording has what is needed.

        Args:
            recording: The recording.
            judged: Names of the sensors that are measured against the reference.

        Raises:
            ValueError: It has not.
        """
        ...

    def cloud(self, recording: Recording, index: int, judged: Collection[str], /) -> InVehicle:
        """The reference cloud of an instant.

        Raises:
            OSError, ValueError: It cannot be read, or has no points.
        """
        ...

    def square_metres(self, recording: Recording, /) -> bool:
        """Whether its points have weights, the square metres that they stand for."""
        ...

    def record(self, recording: Recording, judged: Collection[str], /) -> Mapping[str, object]:
        """For `summary.json`: `sensor`, settings, and `notes`: what the reader of the numbers has to know."""
        ...


class RecordedReference:
    """The clouds of the sensors that were recorded to be the reference."""

    def check(self, recording: Recording, judged: Collection[str]) -> None:
        """Whether there are any."""
        if not recording.reference_sensors:
            raise ValueError(
                f"{recording.path}: no sensor of it was recorded as a reference; accumulate one of all its sensors "
                "(--reference accumulated, AccumulatedReference())"
            )

    def cloud(self, recording: Recording, index: int, judged: Collection[str]) -> InVehicle:
        """All of them, at that instant."""
        scans = [recording.scan(sensor, index) for sensor in recording.reference_sensors]
        found = joined([in_vehicle(scan, recording.body) for scan in scans])
        if not len(found.points_m):
            where = ", ".join(scan.source for scan in scans)
            raise ValueError(f"{where}: the reference cloud has no points, so there is nothing to measure against")
        return found

    def square_metres(self, recording: Recording) -> bool:
        """Whether they were recorded with them."""
        return recording.square_metres

    def record(self, recording: Recording, judged: Collection[str]) -> Mapping[str, object]:
        """That it was recorded."""
        sensors = ", ".join(recording.reference_sensors)
        return {"sensor": "recorded", "notes": [f"Reference: recorded by {sensors}."]}
