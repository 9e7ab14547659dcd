"""Frames without scenes: scores are a closed-form function of the mounts, with noise that pairing removes."""

from dataclasses import replace

import numpy as np

from tests.placement.worlds import estimate_values
from torchcover.placement import Objective, SearchPlan, SearchSpace
from torchcover.placement.common_frames import Score
from torchcover.simulation import Scenario

NUM_QUANTITIES = 2
BEST_X, BEST_PITCH = 0.15, 4.0
NEAR = {"near": Objective(region="20m")}


def compute_near_far(rig):
    """Compute the scores near and far: positive pitch improves near and reduces far."""
    mount = rig.sensors[0].mount
    away = 0.05 * (mount.x_m - BEST_X) ** 2
    near = 0.6 - away - 0.0004 * (mount.pitch_deg - BEST_PITCH) ** 2
    far = 0.4 - away - 0.0008 * (mount.pitch_deg + BEST_PITCH) ** 2
    return np.array([near, far])


class Surface:
    """Frames of several scenes, each with its own mean score and its own effect of a mount."""

    def __init__(
        self,
        seed=0,
        num_scenes=6,
        frames_per_scene=3,
        compute_values=compute_near_far,
        noise=0.002,
        objectives=NEAR,
        blind=False,
        average="area",
    ):
        rng = np.random.default_rng([seed, 99])
        self.seed, self.compute_values, self.noise, self.blind = seed, compute_values, noise, blind
        self.objectives, self.average = dict(objectives), average
        self.scene_ids = np.repeat(np.arange(num_scenes), frames_per_scene)
        self.level = rng.normal(0.0, 0.1, (len(self.scene_ids), NUM_QUANTITIES))
        self.tilt = rng.normal(0.0, noise, (len(self.scene_ids), NUM_QUANTITIES, 2))
        self.scored, self.closed = [], False
        self.scenarios = (Scenario.load("courtyard"),)

    def __len__(self):
        return len(self.scene_ids)

    def _estimate(self, rig):
        mount = rig.sensors[0].mount
        offset = self.tilt @ np.array([mount.x_m, mount.pitch_deg / 10])
        share = self.compute_values(rig)[None] + self.level + offset
        share = np.where(self.blind, np.nan, share)
        share = share[:, np.arange(len(self.objectives)) % NUM_QUANTITIES]  # further objectives repeat near and far
        estimate = estimate_values(share, self.scene_ids)
        quantities = []
        for quantity, name in zip(estimate.quantities, self.objectives, strict=True):
            quantities.append(quantity._replace(key=name))
        return replace(estimate, quantities=tuple(quantities))

    def score(self, rig):
        self.scored.append(rig.name)
        return Score(self._estimate(rig), max(0.0, rig.sensors[0].mount.pitch_deg) / 100)

    def resample(self, seed, num_scenes, extra_objectives):
        return Surface(
            seed,
            num_scenes,
            3,
            self.compute_values,
            self.noise,
            {**self.objectives, **extra_objectives},
            average=self.average,
        )

    def close(self):
        self.closed = True


def space(*, objectives=("near",), **changes):
    """Build a space of x and pitch of the roof LiDAR; its scenario is not simulated."""
    content = {
        "name": "roof",
        "start": "front_roof_32",
        "scenario": "urban",
        "free": {"roof": {"x_m": (-0.6, 0.8), "z_m": 1.8, "pitch_deg": (-10.0, 15.0)}},
        "objectives": objectives if isinstance(objectives, dict) else {name: {"region": "20m"} for name in objectives},
    }
    return SearchSpace.model_validate({**content, **changes})


def plan(**settings):
    """Build a plan whose frames are surfaces."""
    compute_values = settings.pop("compute_values", compute_near_far)
    blind = settings.pop("blind", False)

    def make_surface(space, plan, seed, num_scenes):
        options = {"objectives": space.scored_objectives, "blind": blind, "average": plan.average}
        return Surface(seed, num_scenes, plan.frames_per_scene, compute_values, **options)

    budget = {} if "budget_s" in settings else {"num_evaluations": 20}
    return SearchPlan(**{**budget, "make_frames": make_surface, **settings})
