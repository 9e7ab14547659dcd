"""Rank correlation of metrics and raters: perfect, random, and best of many."""

from itertools import permutations

import numpy as np
import pytest

from torchcover.contrib import PlacementRatings, Ranking, compare_correlations, correlate_rankings, read_results
from torchcover.contrib.ranks import compute_spearman
from torchcover.estimation import Quantity
from torchcover.files import BadFileError
from torchcover.simulation import Rig, get_builtin_folder

HEADER = "placement,quantity,model,class,value\n"
PLACE3D = read_results(get_builtin_folder("published") / "place3d_2024.csv")


def judged_by(values):
    values = np.array(values, dtype=float)
    placements = tuple(f"placement {number}" for number in range(values.shape[1]))
    return PlacementRatings("AP", placements, tuple(f"net {number}" for number in range(len(values))), values)


def metric(values, draws=None, name="metric"):
    return Ranking.from_values(Quantity(name, name, "share", lower_is_better=False), values, "published", draws)


def test_perfect_metrics_have_rank_correlation_1():
    truth = judged_by([[3.0, 1.0, 4.0, 1.5, 5.0], [3.5, 0.0, 4.5, 2.0, 6.0]])
    result = correlate_rankings([metric(truth.mean, name="same"), metric(-truth.mean, name="opposite")], truth)
    for row, value in zip(result.correlations, (1.0, -1.0), strict=True):
        assert row.spearman == (pytest.approx(value),) * 3
        assert row.kendall == (pytest.approx(value),) * 3
        assert row.p_value == pytest.approx(2 / 120)
    assert result.best_p_value == pytest.approx(2 / 120)  # equal or opposite order


def test_constant_metrics_have_no_rank_correlation():
    truth = judged_by([[1.0, 2.0, 3.0, 4.0]])
    result = correlate_rankings([metric([7.0] * 4, name="rays"), metric([1.0, 3.0, 2.0, 4.0], name="other")], truth)
    assert np.isnan(
        [*result.correlations[0].spearman, *result.correlations[0].kendall, result.correlations[0].p_value]
    ).all()
    assert (result.metric_count, result.best_metric) == (1, "other")
    nothing = correlate_rankings([metric([7.0] * 4)], truth)
    assert (nothing.metric_count, nothing.best_metric) == (0, None)
    assert np.isnan([nothing.best_p_value, nothing.chance_threshold]).all()


def test_best_p_values_are_uniform_under_chance():
    generator = np.random.default_rng(0)
    many, values = [metric(generator.normal(size=4)) for _ in range(6)], generator.normal(size=4)
    # Under chance, all orders of the target are equally likely.
    result = [
        correlate_rankings(many, judged_by([values[order]]), num_samples=1)
        for order in map(list, permutations(range(4)))
    ]
    best, alone = (
        np.array(p)
        for p in zip(*((one.best_p_value, [row.p_value for row in one.correlations]) for one in result), strict=True)
    )
    for level in np.unique(best):
        assert (best <= level).mean() == pytest.approx(level)
    # The uncorrected p-value of the best metric is significant far too often.
    for level in np.unique(alone)[:2]:
        assert (alone[:, 0] <= level).mean() == pytest.approx(level)
        assert (alone.min(axis=1) <= level).mean() > 2 * level


def test_intervals_resample_raters_scenes_and_placements():
    generator = np.random.default_rng(2)
    values = np.arange(6.0)
    alike, unlike = judged_by([values] * 4), judged_by(values + generator.normal(0, 2, (4, 6)))

    def width(candidate, judged, **how):
        relation = correlate_rankings([candidate], judged, **how).correlations[0].spearman
        return relation.high - relation.low

    sure = metric(values)
    noisy = metric(values, values + generator.normal(0, 2, (500, 6)))
    assert width(sure, alike) == 0.0
    assert width(sure, unlike) > 0.05
    assert width(noisy, alike) > 0.1
    assert width(sure, unlike, resample_placements=True) > width(sure, unlike)


def test_shared_variation_cancels_in_correlation_differences():
    generator = np.random.default_rng(3)
    truth = judged_by(np.arange(6.0) + generator.normal(0, 2, (4, 6)))
    first, second = metric(np.arange(6.0)), metric(generator.permutation(6))
    rho = [row.spearman.value for row in correlate_rankings([first, second], truth).correlations]
    assert compare_correlations(first, second, truth).value == pytest.approx(rho[0] - rho[1])
    assert compare_correlations(first, metric(first.scores**3), truth, resample_placements=True) == (0.0, 0.0, 0.0)


def test_other_numbers_of_placements_are_refused():
    truth = judged_by([[1.0, 2.0, 3.0]])
    with pytest.raises(ValueError, match="a value of each of 3 placements"):
        correlate_rankings([metric([1.0, 2.0])], truth)
    with pytest.raises(ValueError, match="500 draws"):
        correlate_rankings([metric([1.0, 2.0, 3.0], np.zeros((7, 3)))], truth)


# Published results


def test_place3d_tables_have_the_published_means():
    cars = PLACE3D["map", "car"]
    assert dict(zip(cars.placements, cars.mean.round(3).tolist(), strict=True)) == {
        "center": 52.525, "line": 49.65, "pyramid": 52.175, "square": 49.95, "trapezoid": 50.925,
        "line_roll": 51.025, "pyramid_roll": 52.125, "optimised_detection": 53.375,
    }  # fmt: skip
    ceilings = {
        category: PLACE3D["map", category].inter_rater_correlation for category in ("car", "bicycle", "pedestrian")
    }
    assert ceilings == {
        "car": pytest.approx(0.85, abs=0.01),
        "bicycle": pytest.approx(0.20, abs=0.01),
        "pedestrian": pytest.approx(-0.10, abs=0.01),
    }
    assert PLACE3D["miou", ""].raters == ("MinkUNet", "PolarNet", "SPVCNN", "Cylinder3D")
    # The metric of the paper ranks placements for cars as its detectors do.
    assert compute_spearman(
        PLACE3D["m_sog_1e-6", "detection"].select(cars.placements).mean, cars.mean
    ) == pytest.approx(1.0)


def test_every_placement_of_the_table_is_a_rig():
    for judged in PLACE3D.values():
        for placement in judged.placements:
            assert Rig.load(f"place3d2024_{placement}").name == f"place3d2024_{placement}"


@pytest.mark.parametrize(
    ("values", "ceiling"),
    [
        ([[1, 2, 3, 4]], np.nan),
        ([[1, 2, 3, 4], [10, 20, 30, 40]], 1.0),
        ([[1, 2, 3, 4], [4, 3, 2, 1]], -1.0),
        # Two equal series and one opposite: (1 - 1 - 1) / 3.
        ([[1, 2, 3, 4], [1, 2, 3, 4], [4, 3, 2, 1]], -1 / 3),
    ],
)
def test_the_ceiling_is_what_judges_agree_on(values, ceiling):
    judges = tuple(f"net {number}" for number in range(len(values)))
    judged = PlacementRatings("AP", tuple("abcd"), judges, np.array(values, dtype=float))
    assert judged.inter_rater_correlation == pytest.approx(ceiling, nan_ok=True)


def test_placements_can_be_chosen_but_not_made_up():
    judged = PlacementRatings("AP", tuple("abc"), ("net",), np.array([[1.0, 2.0, 3.0]]))
    assert judged.select(["c", "a"]).values.tolist() == [[3.0, 1.0]]
    with pytest.raises(ValueError, match="nothing is known of d"):
        judged.select(["a", "d"])
    with pytest.raises(ValueError, match="a finite number"):
        PlacementRatings("AP", tuple("abc"), ("net",), np.array([[1.0, np.nan, 3.0]]))


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("a,map,net,car,1\na,map,net,car,2\n", "twice"),
        ("a,map,net,car,1\nb,map,net,car,2\na,map,other,car,2\n", "no value of other on b"),
        ("a,map,net,car,high\n", "a finite number is needed; got 'high'"),
    ],
)
def test_incomplete_tables_are_refused_by_name(tmp_path, rows, words):
    path = tmp_path / "results.csv"
    path.write_text(HEADER + rows)
    with pytest.raises(BadFileError, match=words) as told:
        read_results(path)
    assert str(path) in str(told.value)
