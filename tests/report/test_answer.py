"""What a page shows first: colours that everybody can tell apart, words that are text, dots where the shares are."""

import re
from importlib.resources import files
from itertools import combinations

import numpy as np
import pytest

from torchcover.estimation import Number, Quantity
from torchcover.report import DetectionShares
from torchcover.report.page.svg import render_detection_shares, render_target_maps

# Machado, Oliveira and Fernandes 2009, severity 1: of linear red, green and blue.
SEEING = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
SHARE = Quantity("detection_0.4m", "detection within 0.4 m", "share", lower_is_better=False)


# CIE 1976 of linear sRGB, white D65: two colours that are 2 apart are just told apart.
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(linear):
    x, y, z = np.cbrt(linear @ XYZ.T / XYZ.sum(axis=1)).T  # none of these is nearly black
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


@pytest.mark.parametrize("eyes", SEEING)
def test_plan_colors_suit_color_blind_readers(eyes):
    style = files("torchcover.report.page").joinpath("page.css").read_text(encoding="utf-8")
    codes = [re.search(rf"--{name}: #([0-9a-f]{{6}})", style)[1] for name in ("unseen", "one", "two")]
    shown = np.array([[int(code[at : at + 2], 16) for at in (0, 2, 4)] for code in codes]) / 255
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(SEEING[eyes]).T, 0.0, 1.0)
    assert min(np.linalg.norm(one - other) for one, other in combinations(lab(seen), 2)) > 30


def test_shares_are_plotted_at_their_values():
    known, unknown = Number(SHARE, 0.42, 0.01, 0.4, 0.44), Number(SHARE, float("nan"))
    text = render_detection_shares([DetectionShares("<b>", {"a": known, "<i>": unknown})])
    assert '<line x1="40.0" x2="44.0"' in text
    assert '<circle cx="42.0"' in text
    assert text.count("<circle") == 1
    assert "nan" not in text
    assert "42.0  [40.0, 44.0]&nbsp;%" in text
    assert "<b>" not in text
    assert "<i>" not in text


def test_nothing_is_shown_of_nothing():
    assert render_target_maps(()) == render_detection_shares(()) == ""
