"""Instants without a scene: a rig scores by where its sensors are, in closed form, with noise that pairing removes."""

import numpy as np

from torchcover.placement import Scores, SearchPlan, SearchSpace

QUESTIONS = 2
BEST_X, BEST_PITCH = 0.15, 4.0


def near_far(rig):
    """What a rig is worth near and far: near likes pitch, far does not."""
    mount = rig.sensors[0].mount
    away = 0.05 * (mount.x_m - BEST_X) ** 2
    near = 0.6 - away - 0.0004 * (mount.pitch_deg - BEST_PITCH) ** 2
    far = 0.4 - away - 0.0008 * (mount.pitch_deg + BEST_PITCH) ** 2
    return np.array([near, far])


class Surface:
    """Instants of so many worlds, each with its own level, and its own view of a difference."""

    def __init__(self, seed=0, worlds=6, per_world=3, worth=near_far, noise=0.002, objectives=("near",), blind=()):
        draws = np.random.default_rng([seed, 99])
        self.seed, self.worth, self.noise, self.objectives, self.blind = seed, worth, noise, tuple(objectives), blind
        self.world_of = np.repeat(np.arange(worlds), per_world)
        self.level = draws.normal(0.0, 0.1, (len(self.world_of), QUESTIONS))
        self.tilt = draws.normal(0.0, noise, (len(self.world_of), QUESTIONS, 2))
        self.scored, self.closed = [], False

    def __len__(self):
        return len(self.world_of)

    def score(self, rig, instants=None):
        numbers = np.arange(len(self)) if instants is None else np.asarray(instants)
        self.scored += numbers.tolist()
        mount = rig.sensors[0].mount
        offset = self.tilt[numbers] @ np.array([mount.x_m, mount.pitch_deg / 10])
        share = self.worth(rig)[None] + self.level[numbers] + offset
        share[np.isin(self.world_of[numbers], self.blind)] = np.nan
        visible = np.where(np.isnan(share), 0.0, 1.0)
        return Scores(
            instants=numbers,
            world=self.world_of[numbers],
            parts={name: (at,) for at, name in enumerate(self.objectives)},
            seen_m2=np.nan_to_num(share),
            visible_m2=visible,
            known_share=share - 0.1,
            self_hit_share=max(0.0, mount.pitch_deg) / 100,
            rays=1000,
        )

    def anew(self, seed, worlds):
        return Surface(seed, worlds, 3, self.worth, self.noise, self.objectives)

    def close(self):
        self.closed = True


def space(*, objectives=("near",), **changes):
    """x and pitch of the roof LiDAR, in a scenario that nobody plays."""
    content = {
        "name": "roof",
        "start": "front_roof_32",
        "scenario": "urban",
        "free": {"roof": {"x_m": (-0.6, 0.8), "z_m": 1.8, "pitch_deg": (-10.0, 15.0)}},
        "objectives": {name: {"region": "20m"} for name in objectives},
    }
    return SearchSpace.model_validate({**content, **changes})


def plan(**settings):
    """A plan that makes surfaces."""
    worth = settings.pop("worth", near_far)
    blind = settings.pop("blind", ())
    makes = lambda space, plan, seed, worlds: Surface(  # noqa: E731
        seed, worlds, plan.per_world, worth, objectives=tuple(space.objectives), blind=blind
    )
    budget = {} if "budget_s" in settings else {"evaluations": 20}
    return SearchPlan(**{**budget, "instants": makes, **settings})
