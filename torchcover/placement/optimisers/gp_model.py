"""A Gaussian process with a Matérn 5/2 kernel: what a page of torch is enough for."""

import math
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor

import torchcover.geometry.first_calls  # noqa: F401

TINY = 1e-30
# Hyperparameters are learnt from so many values, which costs their third power at every step.
MOST_LEARNT_FROM = 150
DESCENT: dict[str, Any] = {"max_iter": 40, "tolerance_change": 1e-3, "line_search_fn": "strong_wolfe"}
# Of logarithms: nothing that is learnt lies beyond.
FARTHEST = 30.0
# Of the variance of the values: with less, duplicates make the kernel matrix singular.
LEAST_NOISE = 1e-8
# Where marginal likelihoods are flat, lengths near half of a range, a signal as large as the values, little noise.
PRIOR_LENGTH, PRIOR_NOISE = math.log(0.5), math.log(1e-4)
PRIOR_WIDTH, PRIOR_NOISE_WIDTH = 1.0, 2.0
RESTARTS = ((0.0, 0.0), (-1.2, 4.0))


@dataclass(frozen=True, eq=False)
class GaussianProcess:
    """What is known of a function after some values of it, which are shifted and scaled.

    `levels` are as of `Cube`, the options of a choice all as far from each other; `places` (n, variables) float64,
    where it was measured. `log_lengths` (variables,) and `log_signal` are of the kernel, `log_noise` the variance that
    every value has beside its own. `cholesky` (n, n) factors the kernel matrix with the noise, `weights` (n,) are its
    inverse times the values.
    """

    levels: tuple[int, ...]
    places: Tensor
    shift: float
    scale: float
    log_lengths: Tensor
    log_signal: Tensor
    log_noise: Tensor
    cholesky: Tensor
    weights: Tensor

    @classmethod
    def fitted(
        cls, levels: tuple[int, ...], places: Tensor, values: Tensor, errors: Tensor, like: Self | None = None
    ) -> Self:
        """Learn the hyperparameters: the maximum of the marginal likelihood with a weak prior, from several starts.

        Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, algorithm 2.1 and section 5.4. `places`
        are (n, variables) float64, n of 1 or more, with duplicates or without; `values` (n,) and finite; `errors` (n,)
        the standard error of each, 0 for an exact one. Those of `like` are taken instead of learned, if it is given.
        """
        shift = float(values.mean())
        spread = float((values - shift).square().mean().sqrt())
        scale = spread if spread > 1e-12 * float(values.abs().max()) else 1.0  # else rounding is all there is
        standard, noise = (values - shift) / scale, (errors / scale).square()
        if scale != spread:
            standard = torch.zeros_like(standard)
        if like is None:
            some = torch.linspace(0, len(values) - 1, min(len(values), MOST_LEARNT_FROM), device="cpu").round().long()
            learnt = _learnt(_squared_apart(levels, places[some], places[some]), standard[some], noise[some])
        else:
            learnt = like.log_lengths, like.log_signal, like.log_noise
        kernel = _kernel(_squared_apart(levels, places, places), *learnt[:2])
        cholesky = _factor(kernel + torch.diag(noise + learnt[2].exp() + LEAST_NOISE))
        weights = torch.cholesky_solve(standard[:, None], cholesky)[:, 0]
        return cls(levels, places, shift, scale, *learnt, cholesky, weights)

    def predict(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the function, without the noise of a value, at (m, variables) places."""
        across = _kernel(_squared_apart(self.levels, places, self.places), self.log_lengths, self.log_signal)
        explained = torch.linalg.solve_triangular(self.cholesky, across.T, upper=False)
        variance = (self.log_signal.exp() - explained.square().sum(0)).clamp_min(0.0)
        return self.shift + self.scale * (across @ self.weights), self.scale * variance.sqrt()


def _squared_apart(levels: tuple[int, ...], first: Tensor, second: Tensor) -> Tensor:
    """(variables, n, m) squared distances along each variable; 1 between two options."""
    squared = (first.T[:, :, None] - second.T[:, None, :]).square()
    is_choice = torch.tensor(levels, device="cpu")[:, None, None] > 0
    return torch.where(is_choice, (squared > 0).to(squared.dtype), squared)


def _kernel(apart: Tensor, log_lengths: Tensor, log_signal: Tensor) -> Tensor:
    """Matérn 5/2, with a length for each variable."""
    squared = torch.einsum("vnm,v->nm", apart, torch.exp(-2.0 * log_lengths))
    far = (5.0 * squared + TINY).sqrt()  # whose slope at 0 is infinite
    return log_signal.exp() * (1.0 + far + far.square() / 3.0) * torch.exp(-far)


def _factor(matrix: Tensor) -> Tensor:
    """The Cholesky factor, with as much more noise as it takes."""
    for exponent in range(-8, 1):
        cholesky, failed = torch.linalg.cholesky_ex(matrix)
        if not failed:
            factor: Tensor = cholesky
            return factor
        matrix = matrix + 10.0**exponent * torch.diag(matrix.diagonal())
    raise ArithmeticError("the kernel matrix of the places has no Cholesky factor: a place or an error is not finite")


def _learnt(apart: Tensor, standard: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Logarithms of lengths, signal and noise with the highest posterior density among the restarts."""
    count = len(apart)
    length = PRIOR_LENGTH + 0.5 * math.log(count)  # distances grow with the number of variables
    usual = torch.tensor([length] * count + [0.0, PRIOR_NOISE], dtype=standard.dtype, device="cpu")
    ends = []
    for longer, noisier in RESTARTS:
        values = usual + torch.tensor([longer] * count + [0.0, noisier], dtype=standard.dtype, device="cpu")
        descent = torch.optim.LBFGS([values.requires_grad_()], **DESCENT)

        def loss(values: Tensor = values, descent: torch.optim.Optimizer = descent) -> Tensor:
            descent.zero_grad()
            found = _loss(values, usual, apart, standard, noise)
            found.backward()  # type: ignore[no-untyped-call]
            return found

        with torch.enable_grad():
            descent.step(loss)  # type: ignore[no-untyped-call]
        values = values.detach().clamp(-FARTHEST, FARTHEST)
        ends.append((float(_loss(values, usual, apart, standard, noise)), values))
    best = min(ends, key=lambda end: end[0])[1]
    return best[:count], best[count], best[count + 1]


def _loss(values: Tensor, usual: Tensor, apart: Tensor, standard: Tensor, noise: Tensor) -> Tensor:
    """The negative log posterior density of the hyperparameters."""
    count, near = len(apart), values.clamp(-FARTHEST, FARTHEST)
    kernel = _kernel(apart, near[:count], near[count])
    cholesky = _factor(kernel + torch.diag(noise + near[count + 1].exp() + LEAST_NOISE))
    whitened = torch.linalg.solve_triangular(cholesky, standard[:, None], upper=False)
    widths = torch.tensor([PRIOR_WIDTH] * (count + 1) + [PRIOR_NOISE_WIDTH], dtype=values.dtype, device="cpu")
    off = (values - usual) / widths
    found: Tensor = 0.5 * (whitened.square().sum() + off.square().sum()) + cholesky.diagonal().log().sum()
    return found
