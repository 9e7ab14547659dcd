"""`Coverage`: region numbers, files, and the quantiles behind them."""

import json
import math
import pickle
import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchcover.coverage.quantiles import bin_of, histogram_quantiles

from torchcover import BevGrid, Coverage, CoverageMetric, Region

GRID = BevGrid(x=(-1.0, 20.0), y=(-5.0, 5.0), cell=0.5)
COUNTS = dict.fromkeys(Coverage.COUNTS, 3)


def a_coverage(seed=0, thresholds=(0.4, 0.8), grid=GRID, **more):
    random = torch.Generator().manual_seed(seed)
    frames = torch.randint(0, 3, grid.shape, generator=random)
    unknown = frames == 0

    def values(*leading):
        return torch.rand(*leading, *grid.shape, generator=random, dtype=torch.float64).masked_fill(unknown, math.nan)

    return Coverage(
        grid=grid,
        thresholds=thresholds,
        max_radius=30.0,
        probed_steps=frames,
        points=5 * frames,
        radius=values(),
        detection=values(len(thresholds)),
        counts=COUNTS,
        **{name: values(*leading) for name, leading in more.items()},
    )


# Regions


@pytest.mark.parametrize("region", [Region("near", (0.0, 2.0), (-1.0, 1.0)), Region("rear", (-1.0, 0.25), (0.0, 5.0))])
def test_a_regions_number_is_the_unweighted_mean_over_its_known_cells(region):
    result = a_coverage()
    rows = result.summary([region])
    assert [(row.region, row.height) for row in rows] == [(region.name, "ground"), (region.name, "obstacle")]
    for band, row in enumerate(rows):
        inside = [
            (y, x)
            for y, centre_y in enumerate(np.arange(-4.75, 5, 0.5))
            for x, centre_x in enumerate(np.arange(-0.75, 20, 0.5))
            if region.x[0] <= centre_x < region.x[1] and region.y[0] <= centre_y < region.y[1]
        ]
        known = [cell for cell in inside if result.probed_steps[(band, *cell)] > 0]
        assert 0 < len(known) < len(inside)
        assert (row.cells, row.known_cells) == (len(inside), len(known))
        assert row.known_share == len(known) / len(inside)
        assert row.radius_m == pytest.approx(np.mean([result.radius[(band, *cell)] for cell in known]))
        assert list(row.detection) == [0.4, 0.8]
        for at, mean in enumerate(row.detection.values()):
            assert mean == pytest.approx(np.mean([result.detection[(at, band, *cell)] for cell in known]))


def test_a_region_of_which_nothing_is_known_is_unknown():
    result = a_coverage()
    result.probed_steps.zero_()
    row = result.summary([Region("r", (0.0, 2.0), (-1.0, 1.0))])[0]
    assert (row.known_cells, row.known_share) == (0, 0.0)
    assert math.isnan(row.radius_m)
    assert all(math.isnan(value) for value in row.detection.values())


def test_a_cell_that_is_blind_without_end_makes_its_region_so():
    result = a_coverage()
    result.radius[0, 10, 10], result.probed_steps[0, 10, 10] = math.inf, 1
    assert result.summary([Region("all", GRID.x, GRID.y)])[0].radius_m == math.inf


@pytest.mark.parametrize(
    ("x", "y", "names"),
    [
        ((-1.0, 20.0), (-5.0, 5.0), ["20m"]),
        ((0.0, 80.0), (-20.0, 20.0), ["20m", "80m"]),
        ((0.0, 19.0), (-5.0, 5.0), []),
        ((0.0, 20.0), (-5.0, 4.0), []),
        ((0.0, 20.0), (-4.0, 5.0), []),
        ((1.0, 21.0), (-5.0, 5.0), []),
    ],
)
def test_the_regions_of_the_paper_are_given_where_the_grid_holds_them(x, y, names):
    rows = a_coverage(grid=BevGrid(x=x, y=y, cell=1.0)).summary()
    assert [row.region for row in rows if row.height == "ground"] == names


def test_a_region_the_grid_cannot_speak_of_is_refused():
    with pytest.raises(ValueError, match="region 'far' spans x = 0 to 30 m, beyond the grid's -1 to 20 m"):
        a_coverage().summary([Region("far", (0.0, 30.0), (-1.0, 1.0))])
    with pytest.raises(ValueError, match=r"region 'slit' holds no cell centre; the cell is 0\.5 m"):
        a_coverage().summary([Region("slit", (0.3, 0.7), (-1.0, 1.0))])


def test_scalars_are_the_summary_laid_flat():
    result = a_coverage()
    (ground, obstacle), flat = result.summary(), result.scalars()
    assert flat == {
        "radius_m/20m/ground": ground.radius_m,
        "detection_0.4m/20m/ground": ground.detection[0.4],
        "detection_0.8m/20m/ground": ground.detection[0.8],
        "known_share/20m/ground": ground.known_share,
        "radius_m/20m/obstacle": obstacle.radius_m,
        "detection_0.4m/20m/obstacle": obstacle.detection[0.4],
        "detection_0.8m/20m/obstacle": obstacle.detection[0.8],
        "known_share/20m/obstacle": obstacle.known_share,
    }
    assert all(type(value) is float for value in flat.values())


def test_the_share_of_known_cells_is_in_the_repr():
    grid = BevGrid(x=(0.0, 1.0), y=(0.0, 1.0), cell=0.5, heights={"all": (0.0, 1.0)})
    result = a_coverage(grid=grid)
    result.probed_steps[:] = torch.tensor([[[1, 0], [0, 0]]])
    assert repr(result) == "Coverage((1, 2, 2) cells, 3 steps, 25.0% of the cells known)"


# Files


def assert_same(one, other):
    assert one.grid == other.grid
    assert list(one.grid.heights) == list(other.grid.heights)
    for name in ("thresholds", "max_radius", "quantile_levels", "counts"):
        assert getattr(one, name) == getattr(other, name), name
    for name in ("probed_steps", "points", "radius", "detection", "maximum", "pooled", "quantiles"):
        a, b = getattr(one, name), getattr(other, name)
        assert (a is None) == (b is None), name
        if a is not None:
            torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(
    "options",
    [{}, {"thresholds": (), "max_radius": math.inf}, {"maximum": True, "pooled": True, "quantiles": (0.5, 0.9)}],
)
@pytest.mark.parametrize("as_text", [False, True])
def test_a_file_gives_back_what_was_saved(tmp_path, options, as_text):
    heights = {"high": (1.0, 2.0), "low": (-1.0, 0.1)}
    metric = CoverageMetric(BevGrid(x=(-1, 1), y=(0, 0.3), cell=0.1, heights=heights), **{"max_radius": 2.5, **options})
    metric.update(torch.zeros(1, 3), torch.rand(50, 3, generator=torch.Generator().manual_seed(0)))
    result = metric.compute()
    path = tmp_path / "coverage"  # no suffix: the name is left as it is
    result.save(str(path) if as_text else path)
    assert path.is_file()
    assert_same(Coverage.load(str(path) if as_text else path), result)


def test_a_file_can_be_read_by_numpy_alone(tmp_path):
    result = a_coverage()
    result.save(tmp_path / "coverage.npz")
    with np.load(tmp_path / "coverage.npz") as file:
        np.testing.assert_array_equal(file["radius"], result.radius.numpy())
        assert json.loads(str(file["header"]))["grid"]["cell"] == 0.5


def test_a_result_survives_pickling():
    assert_same(pickle.loads(pickle.dumps(a_coverage())), a_coverage())


def test_a_file_that_is_not_there_is_said_to_be_missing(tmp_path):
    for path in (tmp_path / "missing.npz", tmp_path):
        with pytest.raises(FileNotFoundError, match=f"{path.name}: no such coverage file"):
            Coverage.load(path)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "coverage.npz"
    a_coverage(grid=BevGrid(x=(0.0, 2.0), y=(0.0, 1.0), cell=0.5)).save(path)
    return path


NOT_ONE = r"coverage\.npz: not a coverage file as Coverage\.save writes it \(.+\)"


@pytest.mark.parametrize("content", [b"", b"hello world", b"PK\x03\x04" + bytes(100), pickle.dumps([1, 2, 3])])
def test_rubbish_is_refused(saved, content):
    saved.write_bytes(content)
    with pytest.raises(ValueError, match=NOT_ONE):
        Coverage.load(saved)


def test_a_damaged_file_is_refused_or_read_right(saved):
    """Wherever it is cut or a byte is flipped: one kind of error, or a byte that carries nothing."""
    content, result = saved.read_bytes(), Coverage.load(saved)
    damaged = [content[:cut] for cut in range(0, len(content), 53)]
    damaged += [content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :] for at in range(0, len(content), 17)]
    errors = []
    for rubbish in damaged:
        saved.write_bytes(rubbish)
        try:
            assert_same(Coverage.load(saved), result)
        except ValueError as error:
            errors.append(str(error))
    assert len(errors) > len(damaged) / 2
    assert all(re.search(NOT_ONE, error) for error in errors)


def rewrite(path, header=None, **arrays):
    """Save again with another header or other arrays; None leaves one out."""
    with np.load(path) as file:
        content = {**dict(file), **arrays}
    if header is not None:
        content["header"] = np.array(header(json.loads(str(content["header"]))))
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


@pytest.mark.parametrize(
    "change",
    [
        {"header": None, "radius": None},
        {"header": None, "radius": np.zeros((2, 2))},
        {"header": None, "surplus": np.zeros((2, 2, 4))},
        {"header": lambda _: "[1]"},
        {"header": lambda _: "3"},
        {"header": lambda _: "no JSON"},
        {"header": lambda _: '{"format": 1}'},
        {"header": lambda old: json.dumps({name: value for name, value in old.items() if name != "counts"})},
        {"header": lambda old: json.dumps({**old, "grid": {**old["grid"], "cell": 0.7}})},
    ],
)
def test_a_file_with_wrong_parts_is_refused(saved, change):
    rewrite(saved, **change)
    with pytest.raises(ValueError, match=NOT_ONE):
        Coverage.load(saved)


def test_an_array_file_is_no_coverage_file(saved):
    with saved.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match=NOT_ONE):
        Coverage.load(saved)


def test_a_newer_format_is_refused_by_its_number(saved):
    rewrite(saved, header=lambda old: json.dumps({**old, "format": 2, "unheard of": 1}))
    with pytest.raises(ValueError, match=r"coverage\.npz: coverage format 2; this torchcover reads format 1"):
        Coverage.load(saved)


# Quantiles from a histogram


@settings(max_examples=100, deadline=None)
@given(st.lists(st.integers(-5, 5), min_size=2, max_size=6).map(sorted), st.floats(-6, 6))
def test_bin_of_is_the_definition(edges, value):
    found = bin_of(torch.tensor([value], dtype=torch.float64), torch.tensor(edges, dtype=torch.float64)).item()
    bins = [i for i in range(len(edges) - 1) if edges[i] <= value < edges[i + 1]]
    assert found == (bins[0] if bins else -1)


@settings(max_examples=60, deadline=None)
@given(
    values=st.lists(st.floats(0, 9.999), min_size=1, max_size=30),
    level=st.sampled_from([0.0, 0.25, 0.5, 0.75, 1.0]),
)
def test_a_quantile_lies_in_the_bin_of_the_true_one(values, level):
    edges = torch.arange(0, 11, dtype=torch.float64)
    histogram = torch.zeros(10, 2, dtype=torch.float64)
    for value in values:
        histogram[int(value), 0] += 1.0
    found = histogram_quantiles(histogram, edges, (level,))
    true = np.quantile(values, level, method="inverted_cdf")
    assert math.floor(true) <= found[0, 0].item() <= math.floor(true) + 1
    assert found[0, 1].isnan()


def test_quantiles_are_linear_within_a_bin():
    edges = torch.tensor([0.0, 1.0, 3.0, math.inf], dtype=torch.float64)
    histogram = torch.tensor([[0.0], [4.0], [1.0]], dtype=torch.float64)
    found = histogram_quantiles(histogram, edges, (0.0, 0.2, 0.4, 0.8, 0.9, 1.0))
    assert found.flatten().tolist() == [1.0, 1.5, 2.0, 3.0, math.inf, math.inf]
