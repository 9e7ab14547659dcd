"""Candidates: one sensor at many places, of which some are chosen."""

from collections.abc import Iterator
from itertools import product
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, PlainValidator, PositiveFloat, ValidationInfo, model_validator

from torchcover.placement.carrier import Carrier
from torchcover.placement.free_sensor import HEIGHT_M, pose_of
from torchcover.simulation import Document, Pose, Sensor
from torchcover.simulation.rig import read_sensor

MOST_CANDIDATES = 2000


def _sensor(given: Any, info: ValidationInfo) -> Sensor:  # noqa: ANN401  (whatever stood in the file)
    """A sensor as a rig has it, without a name and a mount."""
    if isinstance(given, dict) and (own := [key for key in ("name", "mount") if key in given]):
        raise ValueError(f"{' and '.join(own)}: the places make them; leave them out")
    return read_sensor({"name": "sensor", **given} if isinstance(given, dict) else given, info)


class MountGrid(Document):
    """Places all over mount regions of the vehicle, each with all of some headings and pitches.

    Args:
        region: The regions.
        spacing_m: From one place to the next, about.
        height_m: Above the skin.
        yaw_deg: Headings, from where the region faces.
        pitch_deg: Pitches; positive turns the nose down.
    """

    region: tuple[str, ...] = Field(min_length=1)
    spacing_m: PositiveFloat
    height_m: PositiveFloat = HEIGHT_M
    yaw_deg: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    pitch_deg: tuple[float, ...] = Field(default=(0.0,), min_length=1)

    def poses(self, carrier: Carrier) -> Iterator[tuple[str, Pose]]:
        """Names and poses; where a window of a region has nothing of the body, there is none.

        Raises:
            ValueError: The vehicle has no such region.
        """
        for name in self.region:
            region = carrier.region(name)
            spans = [bounds[1] - bounds[0] for bounds in (region.x_m, region.y_m, region.z_m) if bounds is not None]
            shares = [_middles(max(round(span / self.spacing_m), 1)) for span in spans]
            for number, (u, v) in enumerate(product(*shares)):
                try:
                    point = region.on(carrier.skin, u, v)
                except ValueError:
                    continue
                x, y, z = (point.place_m + self.height_m * point.outward).tolist()
                for yaw, pitch in product(self.yaw_deg, self.pitch_deg):
                    turned = f"_yaw{yaw:g}" * (len(self.yaw_deg) > 1) + f"_pitch{pitch:g}" * (len(self.pitch_deg) > 1)
                    yield f"{name}_{number}{turned}", pose_of(x, y, z, region.heading_deg + yaw, pitch, 0.0)


def _middles(count: int) -> list[float]:
    shares: list[float] = ((np.arange(count) + 0.5) / count).tolist()
    return shares


class CandidateGroup(Document):
    """A sensor, and where it may be.

    Args:
        sensor: As a rig has it, without name and mount.
        places: Poses, by name; and, or,
        grid: places all over mount regions.

    Example:
        >>> corner = CandidateGroup(
        ...     sensor={"type": "lidar", "model": "velodyne_vlp16"},
        ...     places={"left": {"x_m": 0.4, "y_m": 0.25, "z_m": 0.3}},
        ... )
        >>> corner.places["left"].y_m, corner.sensor.model
        (0.25, 'velodyne_vlp16')
    """

    sensor: Annotated[Sensor, PlainValidator(_sensor)]
    places: dict[str, Pose] = Field(default_factory=dict)
    grid: MountGrid | None = None

    @model_validator(mode="after")
    def _check_places(self) -> Self:
        if not self.places and self.grid is None:
            raise ValueError("places, grid: at least one of the two is needed; got neither")
        return self

    def sensors(self, group: str, carrier: Carrier) -> Iterator[Sensor]:
        """A sensor at each place, called after the group and the place.

        Args:
            group: Name of the group.
            carrier: What it is mounted on.

        Raises:
            ValueError: The vehicle has no such region.
        """
        places = list(self.places.items())
        if self.grid is not None:
            places += self.grid.poses(carrier)
        assert isinstance(self.sensor, Document)  # as all sensors of a rig
        for place, pose in places:
            yield self.sensor.model_copy(update={"name": f"{group}_{place}", "mount": pose})
