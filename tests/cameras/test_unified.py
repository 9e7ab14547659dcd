"""Where the unified models end: at the fold of their image, or where it goes to infinity."""

import math

import pytest
import torch

from torchcover.cameras.models import DoubleSphereChart, ExtendedChart, SphereChart

CHARTS = [
    *(SphereChart(xi) for xi in (0.0, 0.3, 1.0, 1.0 + 1e-9, 1.2, 1.5, 3.0)),
    *(ExtendedChart(alpha, beta) for alpha in (0.0, 0.3, 0.5, 0.5 + 1e-9, 0.6, 1.0) for beta in (0.5, 1.0, 2.0)),
    *(DoubleSphereChart(xi, alpha) for alpha in (0.0, 0.4, 0.5, 0.5 + 1e-9, 0.7, 1.0) for xi in (-0.6, 0.0, 0.4, 0.99)),
]


def directions(angles):
    angles = torch.as_tensor(angles, dtype=torch.float64)
    return 0.6 * torch.sin(angles), -0.8 * torch.sin(angles), torch.cos(angles)


def rim_of(chart):
    """The largest angle off the axis that is shown, by halving."""
    shown, hidden = 0.0, math.pi
    for _ in range(60):
        middle = (shown + hidden) / 2
        is_shown = bool(chart.project(*directions([middle]))[2])
        shown, hidden = (middle, hidden) if is_shown else (shown, middle)
    return shown


@pytest.mark.parametrize("chart", CHARTS, ids=str)
def test_image_radius_grows_up_to_the_rim(chart):
    """All before the rim is shown, farther out the farther off the axis, and lifted to where it came from."""
    rim = rim_of(chart)
    angles = rim * (1 - torch.logspace(-6, 0, 400, dtype=torch.float64))
    x, y, shown = chart.project(*directions(angles))
    radius = torch.hypot(x, y)
    assert shown.all()
    assert (radius[:-1] >= radius[1:] * (1 - 1e-12)).all()
    assert radius.max() <= chart.limit * (1 + 1e-9)
    well = angles < 0.999 * rim
    lifted = chart.unproject(x[well], y[well])
    torch.testing.assert_close(lifted, torch.stack(directions(angles[well]), dim=-1), atol=1e-5, rtol=0)
    if rim < math.pi - 1e-5:  # else all is shown but what lies straight back
        beyond = rim + (math.pi - rim) * torch.logspace(-9, 0, 50, dtype=torch.float64)
        assert not chart.project(*directions(beyond))[2].any()


@pytest.mark.parametrize("chart", [one for one in CHARTS if one.limit < 1e3], ids=str)
def test_folding_images_are_largest_at_the_rim(chart):
    rim = rim_of(chart)
    radius = [torch.hypot(*chart.project(*directions([rim * share]))[:2]).item() for share in (1 - 1e-4, 1 - 1e-8)]
    assert radius == pytest.approx([chart.limit] * 2, rel=1e-4)


@pytest.mark.parametrize("chart", [one for one in CHARTS if math.isinf(one.limit)], ids=str)
def test_unlimited_images_grow_to_infinity(chart):
    rim = rim_of(chart)
    assert torch.hypot(*chart.project(*directions([rim * (1 - 1e-6)]))[:2]).item() > 100.0
