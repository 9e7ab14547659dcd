"""People who go to and fro across a carriageway, each on a path of their own, when it will stay free."""

from dataclasses import dataclass

import numpy as np

from torchcover.geometry.arrays import Bools, Float64
from torchcover.simulation.traffic.scenery import PAVEMENT_M

# Probability to take the first chance after a stay, instead of waiting for another.
EAGERNESS = 0.8
MAX_STAY_S = 12.0


@dataclass(frozen=True, eq=False)
class Footpath:
    """A straight way from one (2,) waiting place to another, with a kerb `kerb_m` behind both, or none."""

    start_m: Float64
    end_m: Float64
    kerb_m: float | None = None

    @property
    def length_m(self) -> float:
        """From one waiting place to the other."""
        return float(np.linalg.norm(self.end_m - self.start_m))

    def poses(self, share: Float64, back: Bools, body_radius_m: float) -> tuple[Float64, Float64]:
        """(T, 3) positions and (T,) headings in degrees of who has gone (T,) shares of the way, forth or back.

        The body steps down when all of it, so far from its middle, is past the kerb.
        """
        way = self.end_m - self.start_m
        yaw = np.rad2deg(np.arctan2(way[1], way[0])) + 180.0 * back
        position = self.start_m + share[:, None] * way
        if self.kerb_m is None:
            height = np.zeros(len(share))
        else:
            height = step_height(np.minimum(share, 1 - share) * self.length_m - self.kerb_m, body_radius_m)
        return np.column_stack([position, height]), yaw


def walk(
    path: Footpath,
    may_go: Bools,
    crossing_s: float,
    times_s: Float64,
    body_radius_m: float,
    generator: np.random.Generator,
) -> tuple[Float64, Float64]:
    """Go to and fro on a path, `crossing_s` each way: (T, 3) positions and (T,) headings in degrees at even times.

    One sets off only when one may, (T,), as who does then finds the way free until the end.
    """
    count, step_s = len(may_go), float(times_s[1] - times_s[0])
    chances = np.flatnonzero(may_go)
    steps = int(np.ceil(crossing_s / step_s))
    back = bool(generator.random() < 0.5)
    share, faces_start = np.full(count, float(back)), np.full(count, back)
    now = 0
    while True:
        now += round(generator.uniform(0.0, MAX_STAY_S) / step_s)
        ahead = chances[np.searchsorted(chances, now) :]
        if len(ahead) == 0:
            return path.poses(share, faces_start, body_radius_m)
        set_off = int(ahead[0])
        now = set_off + 1
        if generator.random() < EAGERNESS:
            gone = np.clip((np.arange(count) - set_off) / steps, 0.0, 1.0)[set_off:]
            share[set_off:] = 1.0 - gone if back else gone
            arrived = set_off + steps
            faces_start[arrived:] = not back
            back, now = not back, arrived


def step_height(beyond_kerb_m: Float64, body_radius_m: float | Float64) -> Float64:
    """Height of the feet of somebody whose middle is so far beyond the kerb, on the carriageway's side."""
    stepping = (beyond_kerb_m - body_radius_m) / PAVEMENT_M
    return PAVEMENT_M * (1.0 - np.clip(stepping, 0.0, 1.0))


def free_for(blocked: Bools, duration_s: float, step_s: float) -> Bools:
    """(T,) whether nothing is blocked from each time on for a duration; what is after the last time counts as free."""
    steps = int(np.ceil(duration_s / step_s))
    before = np.concatenate([[0], np.cumsum(blocked)])
    here = np.arange(len(blocked))
    return np.asarray(before[np.minimum(here + steps + 1, len(blocked))] == before[here])
