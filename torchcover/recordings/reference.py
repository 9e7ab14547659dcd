"""Reference clouds of a recording: the interface of their sources, and references that were recorded."""

from collections.abc import Collection, Mapping
from typing import Protocol

from torchcover.recordings.recording import Recording
from torchcover.recordings.vehicle_cloud import VehicleCloud, join_clouds, transform_to_vehicle


class Reference(Protocol):
    """Source of the reference clouds of a recording."""

    def check(self, recording: Recording, evaluated_sensors: Collection[str], /) -> None:
        """Check that a recording has what the reference needs.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the evaluated sensors.

        Raises:
            ValueError: Something is missing.
        """

    def build_cloud(self, recording: Recording, index: int, evaluated_sensors: Collection[str], /) -> VehicleCloud:
        """Build the reference cloud of a frame.

        Args:
            recording: The recording.
            index: Index of the frame.
            evaluated_sensors: Names of the evaluated sensors.

        Returns:
            The cloud in the vehicle frame.

        Raises:
            OSError: A file cannot be read.
            ValueError: A file has another content, or the cloud has no points.
        """

    def has_area_weights(self, recording: Recording, /) -> bool:
        """Return whether the points have weights in square meters, the areas that they represent.

        Args:
            recording: The recording.
        """

    def describe(self, recording: Recording, evaluated_sensors: Collection[str], /) -> Mapping[str, object]:
        """Describe the reference for `summary.json`.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the evaluated sensors.

        Returns:
            `sensor`, settings, and `notes` that a reader of the numbers needs.
        """


class RecordedReference:
    """Reference made of the clouds of the sensors that were recorded for it.

    Example:
        >>> RecordedReference()  # doctest: +ELLIPSIS
        <torchcover.recordings.reference.RecordedReference object at ...>
    """

    def check(self, recording: Recording, evaluated_sensors: Collection[str]) -> None:
        """Check that the recording has reference sensors.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the evaluated sensors.

        Raises:
            ValueError: There is none.
        """
        if not recording.reference_sensors:
            raise ValueError(
                f"{recording.path}: no sensor of it was recorded as a reference; accumulate one of all its sensors "
                "(--reference accumulated, AccumulatedReference())"
            )

    def build_cloud(self, recording: Recording, index: int, evaluated_sensors: Collection[str]) -> VehicleCloud:
        """Join the clouds of all reference sensors in a frame.

        Args:
            recording: The recording.
            index: Index of the frame.
            evaluated_sensors: Names of the evaluated sensors.

        Returns:
            The cloud in the vehicle frame.

        Raises:
            OSError: A file cannot be read.
            ValueError: A file has another content, or the cloud has no points.
        """
        scans = [recording.read_scan(sensor, index) for sensor in recording.reference_sensors]
        cloud = join_clouds([transform_to_vehicle(scan, recording.ego_box) for scan in scans])
        if not len(cloud.points_m):
            sources = ", ".join(scan.source for scan in scans)
            raise ValueError(f"{sources}: the reference cloud has no points, so there is nothing to measure against")
        return cloud

    def has_area_weights(self, recording: Recording) -> bool:
        """Return whether the clouds were recorded with areas.

        Args:
            recording: The recording.
        """
        return recording.has_area_weights

    def describe(self, recording: Recording, evaluated_sensors: Collection[str]) -> Mapping[str, object]:
        """Describe the reference for `summary.json`: it was recorded, and by which sensors.

        Args:
            recording: The recording.
            evaluated_sensors: Names of the evaluated sensors.
        """
        sensors = ", ".join(recording.reference_sensors)
        return {"sensor": "recorded", "notes": [f"Reference: recorded by {sensors}."]}
