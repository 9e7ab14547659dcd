"""Aggregations in addition to the mean of means by their definitions, and custom ones."""

import math
import re
from dataclasses import dataclass, fields
from itertools import product
from typing import ClassVar

import numpy as np
import pytest
import torch

from torchcover import BevGrid, Coverage, CoverageMetric, Region
from torchcover.coverage import (
    AGGREGATIONS,
    Aggregation,
    FrameQuantiles,
    Layer,
    Maximum,
    PooledMean,
    Quantiles,
    SumState,
    parse_aggregation,
)
from torchcover.coverage.number import estimate_number, list_number_keys
from torchcover.estimation import Estimate, Quantity
from torchcover.report import RENDERERS, CoverageTable

ONE_CELL = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
NOTHING = torch.zeros(0, 3)
ORIGIN = torch.zeros(1, 3)


def points_at(*distances):
    """Create reference points in one cell at these distances from a sensor point at the origin."""
    return torch.tensor([[0.0, distance, 0.0] for distance in distances]).reshape(-1, 3)


def coverage(steps, grid=ONE_CELL, **options):
    metric = CoverageMetric(grid, **options)
    for sensor, reference in steps:
        metric.update(sensor, reference)
    return metric.compute()


def quantile(steps, level, grid=ONE_CELL, kind=Quantiles, **options):
    result = coverage(steps, grid, aggregations=[kind((level,))], **options)
    return list(result.layers.values())[-1].values.item()


# Quantiles over points


@pytest.mark.parametrize("level", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_quantiles_are_right_within_a_bin(level):
    """Bins are 12 % or 1 cm wide."""
    grid = BevGrid(x_m=(0.0, 64.0), y_m=(0.0, 64.0), cell_m=64.0, heights={"all": (-1.0, 1.0)})
    random = np.random.default_rng(0)
    distances = np.concatenate([10 ** random.uniform(-4, 1.7, 801)])
    expected = np.quantile(distances, level, method="inverted_cdf")
    assert abs(quantile([(ORIGIN, points_at(*distances))], level, grid) - expected) <= max(0.123 * expected, 0.01)


def test_steps_weigh_the_same_in_a_quantile():
    steps = [(ORIGIN, points_at(*[0.1] * 500)), (ORIGIN, points_at(0.8)), (ORIGIN, points_at(0.8))]
    assert quantile(steps, 0.5) == pytest.approx(0.8, rel=0.13)


def test_quantiles_beyond_the_histogram_are_max_radius():
    grid = BevGrid(x_m=(0.0, 512.0), y_m=(0.0, 512.0), cell_m=512.0, heights={"all": (-1.0, 1.0)})
    steps = [(ORIGIN, points_at(1.0, 200.0, 300.0))]
    assert quantile(steps, 0.9, grid, max_radius_m=250.0) == 250.0
    assert quantile(steps, 0.9, grid) == math.inf
    assert quantile([(NOTHING, points_at(0.5))], 0.5) == math.inf


def test_smallest_quantile_is_positive_for_positive_values():
    least = quantile([(ORIGIN, points_at(0.5, 0.75))], 0.0)
    assert least == pytest.approx(0.5, rel=0.13)
    assert quantile([(ORIGIN, points_at(0.0, 0.75))], 0.0) == 0


# Quantiles over steps


@pytest.mark.parametrize("level", [0.0, 0.25, 0.5, 0.9, 1.0])
def test_frame_quantiles_are_quantiles_of_frame_means(level):
    random = np.random.default_rng(3)
    steps = [random.uniform(0.02, 0.9, random.integers(1, 9)) for _ in range(101)]
    means = [np.float32(step).astype(float).mean() for step in steps]
    result = quantile([(ORIGIN, points_at(*step)) for step in steps], level, kind=FrameQuantiles)
    expected = np.quantile(means, level, method="inverted_cdf")
    assert abs(result - expected) <= max(0.123 * expected, 0.01)


def test_a_bad_moment_is_no_bad_point():
    """One blind point in a hundred per frame makes no bad frame; one blind frame in ten does."""
    spread = [(ORIGIN, points_at(*[0.02] * 99, 0.9))] * 10
    assert quantile(spread, 0.95, kind=FrameQuantiles) < 0.04
    moment = [(ORIGIN, points_at(*[0.02] * 10))] * 9 + [(ORIGIN, points_at(*[0.9] * 10))]
    assert quantile(moment, 0.95, kind=FrameQuantiles) == pytest.approx(0.9, rel=0.13)


def test_blind_frames_saturate_unobserved_ones_do_not_count():
    steps = [(ORIGIN, points_at(0.1)), (ORIGIN, NOTHING), (NOTHING, points_at(0.1))]
    assert quantile(steps, 1.0, kind=FrameQuantiles) == math.inf
    assert quantile(steps, 1.0, kind=FrameQuantiles, max_radius_m=2.0) == 2.0
    assert quantile(steps, 0.4, kind=FrameQuantiles) == pytest.approx(0.1, rel=0.13)


# Regions


def random_steps(count, seed=0):
    """Sample weighted reference points around the origin, and a few sensor points."""
    random = np.random.default_rng(seed)
    for _ in range(count):
        points, seen = (torch.from_numpy(random.uniform(-2, 2, (n, 3)) * [1, 1, 0.2]) for n in (60, 3))
        yield seen, points, torch.from_numpy(random.uniform(0.5, 2, 60))


NEAR, ALL = Region("near", (-1.0, 1.0), (-1.0, 1.0)), Region("all", (-2.0, 2.0), (-2.0, 2.0))
BANDS = {"all": (-1.0, 1.0), "high": (0.1, 1.0)}
FOUR = BevGrid(x_m=(-2.0, 2.0), y_m=(-2.0, 2.0), cell_m=1.0, heights=BANDS)
MEANS = {"radius_m", "detection_0.4m"}
EVERY = (Maximum(), PooledMean(), Quantiles((0.5, 0.9)), FrameQuantiles((0.5,)))


def in_regions(steps, first=0, **options):
    metric = CoverageMetric(FOUR, num_blocks=8, aggregations=EVERY, regions=[NEAR, ALL], max_radius_m=9.0, **options)
    for index, (sensor, reference, weights) in enumerate(steps, first):
        metric.update(sensor, reference, weights=weights, block_index=index)
    return metric


def radii_in(region, sensor, reference, weights, band=BANDS["all"]):
    """Compute the radii of the points of a region, with their weights."""
    low, high = (torch.tensor([region.x_m[end], region.y_m[end], band[end]]) for end in (0, 1))
    inside = ((reference >= low) & (reference < high)).all(dim=1)
    return torch.cdist(reference[inside], sensor).amin(dim=1).numpy(), weights[inside].numpy()


def test_region_numbers_aggregate_all_points_of_the_region():
    steps = list(random_steps(40))
    coverage = in_regions(steps, has_area_weights=True).compute()
    for row, (region, band) in zip(coverage.summary(), product((NEAR, ALL), BANDS.values()), strict=True):
        each = [radii_in(region, *step, band) for step in steps]
        radii, m2 = (np.concatenate(parts) for parts in zip(*each, strict=True))
        result = {key: number.value for key, number in row.numbers.items()}
        assert result["radius_maximum_m"] == pytest.approx(radii.max(), rel=1e-6)
        # With area weights, the pooled mean equals the mean over area.
        assert result["radius_pooled_m"] == pytest.approx((radii * m2).sum() / m2.sum(), rel=1e-6)
        assert result["radius_pooled_m"] == pytest.approx(result["radius_m"], rel=1e-12)
        shares = np.concatenate([own / own.sum() for _, own in each])
        order = radii.argsort()
        half = radii[order][np.searchsorted(shares[order].cumsum(), 0.5 * len(steps))]
        assert result["radius_q0.5_m"] == pytest.approx(half, rel=0.13)
        means = [(own * weights).sum() / weights.sum() for own, weights in each]
        assert result["radius_frame_q0.5_m"] == pytest.approx(np.quantile(means, 0.5), rel=0.13)


def test_region_errors_are_jackknife_errors_over_blocks():
    steps = list(random_steps(16))
    coverage = in_regions(steps, has_area_weights=True).compute()
    numbers = coverage.summary()[-1].numbers
    whole = numbers["radius_q0.9_m"].value
    left_out = []
    for block in range(8):
        rest = [step for at, step in enumerate(steps) if at // 2 != block]
        left_out.append(in_regions(rest, has_area_weights=True).compute().summary()[-1].numbers["radius_q0.9_m"].value)
    pseudo = 8 * whole - 7 * np.array(left_out)
    assert numbers["radius_q0.9_m"].error == pytest.approx(pseudo.std(ddof=1) / 8**0.5, rel=1e-9)
    few = in_regions(steps[:8], has_area_weights=True).compute().summary()[-1].numbers
    assert few["radius_pooled_m"].error == pytest.approx(few["radius_m"].error, rel=1e-9)
    assert math.isnan(numbers["radius_maximum_m"].error)
    assert all(math.isnan(number.error) for number in in_regions(steps[:7]).compute().summary()[0].numbers.values())


@pytest.mark.parametrize("has_area_weights", [True, False])
def test_merged_parts_and_files_give_equal_numbers(tmp_path, has_area_weights):
    steps = list(random_steps(64))
    whole = in_regions(steps, has_area_weights=has_area_weights).compute()
    one, other = (
        in_regions(part, first, has_area_weights=has_area_weights) for part, first in ((steps[:5], 0), (steps[5:], 5))
    )
    one.merge_state(other)
    for row, expected in zip(one.compute().summary(), whole.summary(), strict=True):
        for key, number in expected.numbers.items():
            assert row.numbers[key][1:3] == pytest.approx(number[1:3], rel=1e-9, nan_ok=True)
    whole.save(tmp_path / "c.npz")
    assert str(Coverage.load(tmp_path / "c.npz").summary()) == str(whole.summary())
    assert whole.scalars()["radius_q0.9_m_error/near/all"] == whole.summary()[0].numbers["radius_q0.9_m"].error


def test_unobserved_or_unrequested_regions_are_unknown():
    empty = in_regions([(ORIGIN, NOTHING, torch.zeros(0))] * 9).compute()
    other = Region("other", (0.0, 2.0), (0.0, 2.0))
    for coverage, region in ((empty, NEAR), (in_regions(random_steps(9)).compute(), other)):
        numbers = coverage.summary([region])[0].numbers
        assert numbers.keys() >= {"radius_maximum_m", "radius_pooled_m", "radius_q0.5_m", "radius_frame_q0.5_m"}
        assert all(
            not number.has_value and math.isnan(number.error) for key, number in numbers.items() if key not in MEANS
        )


def test_any_number_of_a_result_has_an_estimate():
    def measured(shift):
        metric = CoverageMetric(
            FOUR,
            aggregations=EVERY,
            regions=[NEAR],
            sensor_names=["a", "b"],
            has_area_weights=True,
            num_blocks=8,
            max_radius_m=9.0,
        )
        for world, (seen, reference, weights) in enumerate(random_steps(3)):
            metric.update({"a": seen[:2] + shift, "b": seen[2:]}, reference, weights=weights, block_index=world)
        return metric.compute()

    one, other = measured(0.0), measured(0.1)
    keys = list_number_keys(one)
    assert {"cells_radius_m", "radius_m_without_a", "radius_q0.9_m", "detected_by_two_0.4m"} < set(keys)
    row = one.summary()[0]
    values = {
        **row.numbers,
        **{f"known_{key}": number for key, number in row.cell_averages.items()},
        **row.redundancy.detecting_sensors,
    }
    for key in keys:
        result, compared = (estimate_number(each, key, NEAR, "all") for each in (one, other))
        assert [quantity.key for quantity in result.quantities] == [key]
        if key in values:
            assert float(result.value) == values[key].value
        # Three scenes are too few for a reported error, and enough for early stopping.
        assert result.jackknife_values.shape == (3, 1)
        assert math.isnan(result.error)
        assert compared.subtract(result).compute_errors(3).isnan().tolist() == [key == "radius_maximum_m"]
    with pytest.raises(ValueError, match=r"radius_q0\.8_m: the result has no such number; it has radius_q0"):
        estimate_number(one, "radius_q0.8_m", NEAR, "all")


# Custom aggregations


@dataclass(frozen=True)
class Blind(Aggregation):
    """Share of points without a near sensor point: a minimal additive aggregation."""

    name: ClassVar[str] = "blind"
    description: ClassVar[str] = "blind shares"

    def create_states(self, num_cells):
        return {name: SumState(torch.zeros(num_cells, dtype=torch.float64)) for name in ("blind", "all")}

    def update(self, sums, frame):
        sums["blind"].index_add_(0, frame.cell_indices, (frame.radius > 0.5).double())
        sums["all"].index_add_(0, frame.cell_indices, torch.ones_like(frame.radius))

    def compute_layers(self, sums, observed_frames, max_radius_m):
        quantity = Quantity("blind_share", "share that nothing is near", "share", lower_is_better=True)
        return [Layer(quantity, sums["blind"] / sums["all"])]


def test_custom_aggregations_appear_in_maps_numbers_and_tables():
    steps = list(random_steps(16))
    metric = CoverageMetric(FOUR, num_blocks=16, aggregations=[Blind()], regions=[NEAR])
    for index, (sensor, reference, _) in enumerate(steps):
        metric.update(sensor, reference, block_index=index)
    result = metric.compute()
    blind = [(radii_in(NEAR, *step)[0] > 0.5) for step in steps]
    base, sums = (
        torch.tensor(each, dtype=torch.float64) for each in ([len(b) for b in blind], [b.sum() for b in blind])
    )
    expected = Estimate.from_ratios((), base, sums[:, None], torch.ones(16))
    number = result.summary()[0].numbers["blind_share"]
    assert (number.value, number.error) == pytest.approx((float(expected.value), float(expected.error)), rel=1e-12)
    assert result.layers["blind_share"].values.shape == FOUR.shape
    table = CoverageTable.from_coverages({"rig": result}, [NEAR])
    assert table.rows["rig"][0].summary.numbers["blind_share"] == number
    for written in ("text", "csv", "json", "markdown"):
        assert "blind_share" in RENDERERS[written](table) or "nothing is near" in " ".join(
            RENDERERS[written](table).split()
        )


@dataclass(frozen=True)
class Minimum(Aggregation):
    """Smallest radius: a minimal aggregation."""

    name: ClassVar[str] = "minimum"
    description: ClassVar[str] = "minima"

    def create_states(self, num_cells):
        return {"negative": SumState(torch.full((num_cells,), -math.inf, dtype=torch.float64), reduction="max")}

    def update(self, sums, frame):
        sums["negative"].scatter_reduce_(0, frame.cell_indices, -frame.radius, "amax")

    def compute_layers(self, sums, observed_frames, max_radius_m):
        quantity = Quantity("radius_minimum_m", "smallest blind spot radius", "m", lower_is_better=True)
        return [Layer(quantity, (-sums["negative"]).where(observed_frames > 0, math.nan))]


def test_notes_on_means_concern_means_only():
    metric = CoverageMetric(
        FOUR, (), aggregations=[Blind()], regions=[NEAR], sensor_names=["a"], has_area_weights=True, max_radius_m=9.0
    )
    for sensor, reference, weights in random_steps(4):
        metric.update({"a": sensor}, reference, weights=weights)
    table = CoverageTable.from_coverages({"rig": metric.compute()}, [NEAR])
    columns = RENDERERS["csv"](table).splitlines()[0].split(",")
    assert {"blind_share", "blind_share_error", "cells_radius_m", "radius_m_without_a"} < set(columns)
    assert not {"known_blind_share", "blind_share_without_a"} & set(columns)
    text = " ".join(RENDERERS["text"](table).split())
    assert "Change of mean blind spot radius (m) when one sensor fails" in text
    assert "Change of share" not in text


def test_custom_aggregations_are_merged_saved_and_loaded(tmp_path):
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    one, other = (CoverageMetric(grid, aggregations=[Minimum()], num_blocks=8) for _ in range(2))
    one.update(ORIGIN, points_at(0.5, 0.25))
    other.update(ORIGIN, points_at(0.75, 0.125), block_index=1)
    one.merge_state(other)
    one.compute().save(tmp_path / "coverage.npz")
    layer = Coverage.load(tmp_path / "coverage.npz").layers["radius_minimum_m"]
    assert layer.quantity.title == "smallest blind spot radius"
    assert layer.values.flatten().tolist() == pytest.approx([0.125, math.nan], nan_ok=True)
    with pytest.raises(ValueError, match="cannot merge metrics with different aggregations"):
        one.merge_state(CoverageMetric(grid, num_blocks=8))


def test_aggregations_have_names_of_their_own():
    assert (
        len({kind.name for kind in AGGREGATIONS})
        == len({kind.description for kind in AGGREGATIONS})
        == len(AGGREGATIONS)
    )


def test_names_create_the_built_in_aggregations():
    for kind in AGGREGATIONS:
        made = parse_aggregation(f"{kind.name}:{kind.example}")
        assert type(made) is kind
        assert bool(fields(kind)) == bool(kind.example)
        with pytest.raises(ValueError, match=rf"^aggregation {kind.name}:\?: .*\S$"):
            parse_aggregation(f"{kind.name}:?")
        keys = [quantity.key for quantity in made.quantities]
        assert kind.from_keys({*keys, "radius_m", "detection_0.4m"}) == made
        assert kind.from_keys({"radius_m", "detection_0.4m"}) is None
        assert not any(other.from_keys(set(keys)) for other in AGGREGATIONS if other is not kind)


def test_the_numbers_of_a_search_make_its_aggregations():
    assert Quantiles.from_keys({"radius_q0.9_m", "radius_q0_m", "radius_frame_q0.5_m"}) == Quantiles((0.0, 0.9))
    assert FrameQuantiles.from_keys({"radius_q0.9_m", "radius_q2_m"}) is None
    assert Quantiles.from_keys({"radius_q2_m", "radius_q1.5_m", "radius_q_m", "radius_q0.9_m_without_roof"}) is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("maximum:0.5", "aggregation maximum:0.5: maximum takes no parameters; leave out what is behind the colon"),
        ("quantiles", "aggregation quantiles: levels are needed, as in quantiles:0.5,0.9"),
        ("quantiles:0.5,2", "aggregation quantiles:0.5,2: levels are needed"),
    ],
)
def test_what_makes_no_aggregation_is_refused(words, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        parse_aggregation(words)


def test_an_unknown_name_lists_all():
    with pytest.raises(ValueError, match=r"^aggregation minimum: one of .* is needed$") as raised:
        parse_aggregation("minimum")
    listed = str(raised.value).removeprefix("aggregation minimum: one of ").removesuffix(" is needed").split(" or ")
    assert [type(parse_aggregation(form)) for form in listed] == list(AGGREGATIONS)
