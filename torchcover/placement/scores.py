"""What rigs score at instants, and what that makes for each world."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from torchcover.coverage import Measure

Float64 = NDArray[np.float64]
Numbers = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scores:
    """What a rig scores at some instants. Q questions are asked; an objective is the mean of some of them.

    Args:
        instants: (n,) int64 numbers of the instants.
        world: (n,) int64 world of each: instants of one world are alike, worlds are independent.
        parts: For each objective, by name in the order of its columns, the columns of its questions.
        seen_m2: (n, Q) square metres of the reference points that the rig sees: within the threshold, in the region and
            band of the question.
        visible_m2: (n, Q) square metres of all of them; the same for every rig.
        known_share: (n, Q) mean over the known cells of the share of their square metres that the rig sees; NaN where
            no cell is known.
        self_hit_share: Share of the rig's rays that the vehicle itself took.
        rays: Rays of the rig at one instant.
    """

    instants: Numbers
    world: Numbers
    parts: dict[str, tuple[int, ...]]
    seen_m2: Float64
    visible_m2: Float64
    known_share: Float64
    self_hit_share: float
    rays: int

    @property
    def objectives(self) -> tuple[str, ...]:
        """Names of the objectives, in the order of the columns."""
        return tuple(self.parts)

    @property
    def area(self) -> Float64:
        """(n, objectives) share of the visible square metres; NaN where any region and band shows none."""
        return self._objectives(_ratio(self.seen_m2, self.visible_m2))

    @property
    def known(self) -> Float64:
        """(n, objectives) mean over known cells of 0.5 m; NaN where any region and band has none."""
        return self._objectives(self.known_share)

    @property
    def worlds(self) -> Numbers:
        """(W,) numbers of the worlds, ascending."""
        return np.unique(self.world)

    def by_world(self, measure: Measure = "area") -> Float64:
        """What it scores in each world: worlds are what is independent.

        Args:
            measure: "area": the ratio of the world's sums; "known": the mean over its instants.

        Returns:
            (W, objectives), in the order of `worlds`; NaN where no instant of the world shows a region and band.
        """
        worlds, row = np.unique(self.world, return_inverse=True)

        def summed(values: Float64) -> Float64:
            sums = np.zeros((len(worlds), values.shape[1]))
            np.add.at(sums, row, values)
            return sums

        if measure == "area":
            return self._objectives(_ratio(summed(self.seen_m2), summed(self.visible_m2)))
        known = ~np.isnan(self.known_share)
        return self._objectives(_ratio(summed(np.where(known, self.known_share, 0.0)), summed(known.astype(float))))

    def at(self, instants: Sequence[int] | Numbers) -> "Scores":
        """Those at some of the instants.

        Raises:
            ValueError: One of them is missing.
        """
        rows = {number: row for row, number in enumerate(self.instants.tolist())}
        wanted = [int(number) for number in instants]
        if missing := [number for number in wanted if number not in rows]:
            raise ValueError(f"instants {missing[:5]}: the rig was not scored there")
        chosen = [rows[number] for number in wanted]
        return replace(
            self,
            instants=self.instants[chosen],
            world=self.world[chosen],
            seen_m2=self.seen_m2[chosen],
            visible_m2=self.visible_m2[chosen],
            known_share=self.known_share[chosen],
        )

    def joined(self, other: "Scores") -> "Scores":
        """Those of the same rig at other instants, too."""
        counts = len(self.instants), len(other.instants)
        own_hits = counts[0] * self.self_hit_share + counts[1] * other.self_hit_share
        return replace(
            self,
            instants=np.concatenate([self.instants, other.instants]),
            world=np.concatenate([self.world, other.world]),
            seen_m2=np.concatenate([self.seen_m2, other.seen_m2]),
            visible_m2=np.concatenate([self.visible_m2, other.visible_m2]),
            known_share=np.concatenate([self.known_share, other.known_share]),
            self_hit_share=own_hits / sum(counts),
        )

    def _objectives(self, of_questions: Float64) -> Float64:
        means = [of_questions[:, list(columns)].mean(axis=1) for columns in self.parts.values()]
        return np.stack(means, axis=1)


def _ratio(sums: Float64, whole: Float64) -> Float64:
    ratio: Float64 = np.full(sums.shape, np.nan)
    np.divide(sums, whole, out=ratio, where=whole > 0)
    return ratio
