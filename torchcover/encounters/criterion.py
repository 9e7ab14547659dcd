"""What is detected, and what is in time; nothing heavy is imported, as the command line takes its options from it."""

import math
from dataclasses import dataclass
from typing import Annotated

# No brakes take longer.
MOST_LATENCY_S = 10.0


@dataclass(frozen=True)
class Criterion:
    """What is detected, and what is in time. Its fields are the options of `torchcover encounter`.

    Raises:
        ValueError: A number out of its bounds.
    """

    points: Annotated[int, "Points that are enough, of all LiDARs together; of a radar one is."] = 5
    pixels: Annotated[int, "Pixels of the full image that are enough, of a camera alone."] = 200
    consecutive_scans: Annotated[int, "In so many looks in a row."] = 3
    deceleration_mps2: Annotated[float, "Of the brakes, in m/s2."] = 9.0
    latency_s: Annotated[float, "Seconds from the last of these looks to the brakes."] = 0.5
    max_ttc_s: Annotated[float, "In traffic: who comes within this time to collision, in seconds, is met."] = 4.0

    def __post_init__(self) -> None:
        for name in ("points", "pixels", "consecutive_scans"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: a number >= 1 is needed; got {getattr(self, name)}")
        for name, unit in (("deceleration_mps2", "m/s2"), ("max_ttc_s", "seconds")):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: {unit} above 0 are needed; got {getattr(self, name)}")
        if not 0 <= self.latency_s <= MOST_LATENCY_S:
            raise ValueError(
                f"latency_s: 0 to {MOST_LATENCY_S:g} seconds are needed; got {self.latency_s:g}, is that milliseconds?"
            )

    def compute_braking_time_s(self, speed_mps: float, approach_speed_mps: float = 0.0) -> float:
        """The time to collision at which braking still prevents it; only the ego brakes, the other goes on.

        After the latency, an ego of speed v that brakes with a stands v / a later, v^2 / (2 a) farther on. Who comes
        towards it with u >= 0 goes u v / a in that time, of a gap that two who do not brake close with v + u:
        latency + (v / a) (v / 2 + u) / (v + u); of who crosses, latency + v / (2 a). From who drives ahead, u < 0, it
        keeps clear once it is no faster: latency + (v + u) / (2 a).

        Args:
            speed_mps: Of the ego, along its way.
            approach_speed_mps: Of the other, along the same way towards the ego; negative if it drives ahead.

        Example:
            >>> [round(Criterion().compute_braking_time_s(50 / 3.6, kmh / 3.6), 2) for kmh in (0, 50, -20)]
            [1.27, 1.66, 0.96]
        """
        closing_mps, towards = speed_mps + approach_speed_mps, approach_speed_mps > 0
        mps = speed_mps * (speed_mps / 2 + approach_speed_mps) / closing_mps if towards else max(closing_mps, 0.0) / 2
        return self.latency_s + mps / self.deceleration_mps2

    @property
    def description(self) -> str:
        """It, for below a table."""
        return (
            f"Detected: {self.points} points of LiDARs, {self.pixels} pixels of a camera, or a point of a radar, in "
            f"{self.consecutive_scans} looks in a row. Needed: to stop with {self.deceleration_mps2:g} m/s2, {self.latency_s:g} s "
            "after that."
        )
