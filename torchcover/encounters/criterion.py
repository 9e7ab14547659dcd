"""Criterion of detection and of braking in time. The command line reads its options here: no heavy imports."""

import math
from dataclasses import dataclass
from typing import Annotated

# Larger values are probably milliseconds: no brake system takes longer.
MAX_LATENCY_S = 10.0


@dataclass(frozen=True)
class Criterion:
    """Criterion of detection and of braking in time. The fields are the options of `torchcover encounter`.

    Args:
        points: LiDAR points that detect a road user, of all LiDARs together; one point of a radar is enough.
        pixels: Pixels of the full image that detect a road user, of one camera.
        consecutive_scans: Consecutive scans that have enough points at detection.
        deceleration_mps2: Deceleration of the ego vehicle.
        latency_s: Time from the last of these scans to the start of braking.
        max_ttc_s: Time to collision from which a road user in traffic counts as an encounter.

    Raises:
        ValueError: A value is out of range.
    """

    points: Annotated[int, "LiDAR points that detect a road user, of all LiDARs; one radar point is enough."] = 5
    pixels: Annotated[int, "Pixels of the full image that detect a road user, of one camera."] = 200
    consecutive_scans: Annotated[int, "Consecutive scans with enough points."] = 3
    deceleration_mps2: Annotated[float, "Deceleration of the vehicle in m/s2."] = 9.0
    latency_s: Annotated[float, "Seconds from the last of these scans to the start of braking."] = 0.5
    max_ttc_s: Annotated[float, "In traffic: time to collision in seconds from which a road user counts."] = 4.0

    def __post_init__(self) -> None:
        for name in ("points", "pixels", "consecutive_scans"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: a number >= 1 is needed; got {getattr(self, name)}")
        for name, unit in (("deceleration_mps2", "m/s2"), ("max_ttc_s", "seconds")):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: {unit} above 0 are needed; got {getattr(self, name)}")
        if not 0 <= self.latency_s <= MAX_LATENCY_S:
            raise ValueError(
                f"latency_s: 0 to {MAX_LATENCY_S:g} seconds are needed; got {self.latency_s:g}, is that milliseconds?"
            )

    def compute_braking_time_s(self, speed_mps: float, approach_speed_mps: float = 0.0) -> float:
        """Compute the time to collision at which braking still prevents the collision; only the ego vehicle brakes.

        After the latency, an ego vehicle of speed v that brakes with a stops within v / a and v^2 / (2 a). A road user
        that approaches with u >= 0 moves u v / a in that time; without braking, both close a gap with v + u. The
        result is latency + (v / a) (v / 2 + u) / (v + u), which is latency + v / (2 a) for a crossing road user. A
        road user that drives ahead, u < 0, is not hit once the ego vehicle is no faster: latency + (v + u) / (2 a).

        Args:
            speed_mps: Speed of the ego vehicle along its path.
            approach_speed_mps: Speed of the road user towards the ego vehicle along the same path; negative if it
                drives ahead.

        Returns:
            Time in seconds.

        Example:
            >>> speeds_kmh = (0, 50, -20)
            >>> [round(Criterion().compute_braking_time_s(50 / 3.6, speed / 3.6), 2) for speed in speeds_kmh]
            [1.27, 1.66, 0.96]
        """
        closing_mps = speed_mps + approach_speed_mps
        if approach_speed_mps > 0:
            lost_mps = speed_mps * (speed_mps / 2 + approach_speed_mps) / closing_mps
        else:
            lost_mps = max(closing_mps, 0.0) / 2
        return self.latency_s + lost_mps / self.deceleration_mps2

    @property
    def description(self) -> str:
        """Sentence for the notes below a table."""
        return (
            f"Detected: {self.points} LiDAR points, {self.pixels} pixels of a camera, or a radar point, in "
            f"{self.consecutive_scans} consecutive scans. Braking time: {self.latency_s:g} s of latency and a stop "
            f"with {self.deceleration_mps2:g} m/s2."
        )
