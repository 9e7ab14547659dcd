"""Frames without a scene: a rig scores by where its sensors are, in closed form, with noise that pairing removes."""

import numpy as np

from tests.placement.worlds import estimate_of
from torchcover.placement import Objective, SearchPlan, SearchSpace
from torchcover.placement.common_frames import Score
from torchcover.simulation import Scenario

QUESTIONS = 2
BEST_X, BEST_PITCH = 0.15, 4.0
NEAR = {"near": Objective(region="20m")}


def near_far(rig):
    """What a rig is worth near and far: near likes pitch, far does not."""
    mount = rig.sensors[0].mount
    away = 0.05 * (mount.x_m - BEST_X) ** 2
    near = 0.6 - away - 0.0004 * (mount.pitch_deg - BEST_PITCH) ** 2
    far = 0.4 - away - 0.0008 * (mount.pitch_deg + BEST_PITCH) ** 2
    return np.array([near, far])


class Surface:
    """Instants of so many worlds, each with its own level, and its own view of a difference."""

    def __init__(
        self,
        seed=0,
        num_scenes=6,
        frames_per_scene=3,
        worth=near_far,
        noise=0.002,
        objectives=NEAR,
        blind=False,
        average="area",
    ):
        draws = np.random.default_rng([seed, 99])
        self.seed, self.worth, self.noise, self.blind = seed, worth, noise, blind
        self.objectives, self.average = dict(objectives), average
        self.scene_ids = np.repeat(np.arange(num_scenes), frames_per_scene)
        self.level = draws.normal(0.0, 0.1, (len(self.scene_ids), QUESTIONS))
        self.tilt = draws.normal(0.0, noise, (len(self.scene_ids), QUESTIONS, 2))
        self.scored, self.closed = [], False
        self.scenarios = (Scenario.load("courtyard"),)

    def __len__(self):
        return len(self.scene_ids)

    def _estimate(self, rig):
        mount = rig.sensors[0].mount
        offset = self.tilt @ np.array([mount.x_m, mount.pitch_deg / 10])
        share = self.worth(rig)[None] + self.level + offset
        share = np.where(self.blind, np.nan, share)
        share = share[:, np.arange(len(self.objectives)) % QUESTIONS]  # what nobody asked for is near or far, too
        found = estimate_of(share, self.scene_ids)
        named = [one._replace(key=name) for one, name in zip(found.quantities, self.objectives, strict=True)]
        return type(found)(tuple(named), found.value, found.jackknife_values, found.frame_counts)

    def score(self, rig):
        self.scored.append(rig.name)
        return Score(self._estimate(rig), max(0.0, rig.sensors[0].mount.pitch_deg) / 100)

    def resample(self, seed, num_scenes, extra_objectives):
        return Surface(
            seed, num_scenes, 3, self.worth, self.noise, {**self.objectives, **extra_objectives}, average=self.average
        )

    def close(self):
        self.closed = True


def space(*, objectives=("near",), **changes):
    """x and pitch of the roof LiDAR, in a scenario that nobody plays."""
    content = {
        "name": "roof",
        "start": "front_roof_32",
        "scenario": "urban",
        "free": {"roof": {"x_m": (-0.6, 0.8), "z_m": 1.8, "pitch_deg": (-10.0, 15.0)}},
        "objectives": objectives if isinstance(objectives, dict) else {name: {"region": "20m"} for name in objectives},
    }
    return SearchSpace.model_validate({**content, **changes})


def plan(**settings):
    """A plan that makes surfaces."""
    worth = settings.pop("worth", near_far)
    blind = settings.pop("blind", False)
    makes = lambda space, plan, seed, num_scenes: Surface(  # noqa: E731
        seed,
        num_scenes,
        plan.frames_per_scene,
        worth,
        objectives=space.scored_objectives,
        blind=blind,
        average=plan.average,
    )
    budget = {} if "budget_s" in settings else {"num_evaluations": 20}
    return SearchPlan(**{**budget, "make_frames": makes, **settings})
