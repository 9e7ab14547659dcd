"""Coverage: numbers of regions, files and quantiles."""

import io
import json
import math
import pickle
import re

import numpy as np
import pytest
import torch

from torchcover import BevGrid, Coverage, CoverageMetric, Region
from torchcover.coverage import FrameQuantiles, Layer, Maximum, MeanOfMeans, PooledMean, Quantiles, compute_differences
from torchcover.coverage.sparse_sums import ObservedCells
from torchcover.detection import Boxes, measure_box_visibility
from torchcover.files import BadFileError
from torchcover.frames import Frame, collate_frames
from torchcover.frames.frame import Measurement

GRID = BevGrid(x_m=(-1.0, 20.0), y_m=(-5.0, 5.0), cell_m=0.5)
EVERY_AGGREGATION = (Maximum(), PooledMean(), Quantiles((0.5, 0.9)), FrameQuantiles((0.9,)))
COUNTS = dict.fromkeys(Coverage.COUNTS, 3)


def a_coverage(seed=0, thresholds_m=(0.4, 0.8), grid=GRID, frames=None):
    random = torch.Generator().manual_seed(seed)
    if frames is None:
        frames = torch.randint(0, 3, grid.shape, generator=random)
    at = frames.flatten().nonzero().squeeze(1)
    known = ObservedCells(grid.shape, at, frames.flatten()[at], 5 * frames.flatten()[at])

    def values():
        return torch.rand(grid.shape, generator=random, dtype=torch.float64).flatten()[at]

    return Coverage(
        grid=grid,
        thresholds_m=thresholds_m,
        max_radius_m=30.0,
        observed_cells=known,
        layers=[Layer(quantity, values()) for quantity in MeanOfMeans(thresholds_m).quantities],
        counts=COUNTS,
    )


# Regions


@pytest.mark.parametrize("region", [Region("near", (0.0, 2.0), (-1.0, 1.0)), Region("rear", (-1.0, 0.25), (0.0, 5.0))])
def test_region_numbers_are_means_over_observed_cells(region):
    result = a_coverage()
    rows = result.summary([region])
    assert [(row.region, row.band) for row in rows] == [(region.name, "ground"), (region.name, "obstacle")]
    for band, row in enumerate(rows):
        inside = [
            (y, x)
            for y, centre_y in enumerate(np.arange(-4.75, 5, 0.5))
            for x, centre_x in enumerate(np.arange(-0.75, 20, 0.5))
            if region.x_m[0] <= centre_x < region.x_m[1] and region.y_m[0] <= centre_y < region.y_m[1]
        ]
        known = [cell for cell in inside if result.observed_frames[(band, *cell)] > 0]
        assert 0 < len(known) < len(inside)
        assert (row.num_cells, row.observed_cells) == (len(inside), len(known))
        assert row.observed_share == len(known) / len(inside)
        assert row.numbers["radius_m"].value == pytest.approx(np.mean([result.radius[(band, *cell)] for cell in known]))
        assert list(row.numbers) == ["radius_m", "detection_0.4m", "detection_0.8m"]
        for at, number in enumerate(list(row.numbers.values())[1:]):
            assert number.value == pytest.approx(np.mean([result.detection[(at, band, *cell)] for cell in known]))


def test_regions_without_observed_cells_are_unknown():
    result = a_coverage(frames=torch.zeros(GRID.shape, dtype=torch.int64))
    row = result.summary([Region("r", (0.0, 2.0), (-1.0, 1.0))])[0]
    assert (row.observed_cells, row.observed_share) == (0, 0.0)
    assert all(math.isnan(number.value) for number in row.numbers.values())


def test_infinite_cells_make_their_region_infinite():
    result = a_coverage()
    result.sparse_layers["radius_m"].values[0] = math.inf
    assert result.summary([Region("all", GRID.x_m, GRID.y_m)])[0].numbers["radius_m"].value == math.inf


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
def test_default_regions_fit_into_the_grid(x, y, names):
    rows = a_coverage(grid=BevGrid(x_m=x, y_m=y, cell_m=1.0)).summary()
    assert [row.region for row in rows if row.band == "ground"] == names


def test_regions_beyond_the_grid_are_refused():
    with pytest.raises(ValueError, match="region 'far' spans x = 0 to 30 m, beyond the grid's -1 to 20 m"):
        a_coverage().summary([Region("far", (0.0, 30.0), (-1.0, 1.0))])
    with pytest.raises(ValueError, match=r"region 'slit' holds no cell center; use smaller cells than 0\.5 m"):
        a_coverage().summary([Region("slit", (0.3, 0.7), (-1.0, 1.0))])


def test_scalars_are_the_summary_laid_flat():
    result = a_coverage()
    (ground, obstacle), flat = result.summary(), result.scalars()
    assert flat == {
        "radius_m/20m/ground": ground.numbers["radius_m"].value,
        "detection_0.4m/20m/ground": ground.numbers["detection_0.4m"].value,
        "detection_0.8m/20m/ground": ground.numbers["detection_0.8m"].value,
        "observed_share/20m/ground": ground.observed_share,
        "radius_m/20m/obstacle": obstacle.numbers["radius_m"].value,
        "detection_0.4m/20m/obstacle": obstacle.numbers["detection_0.4m"].value,
        "detection_0.8m/20m/obstacle": obstacle.numbers["detection_0.8m"].value,
        "observed_share/20m/obstacle": obstacle.observed_share,
    }
    assert all(type(value) is float for value in flat.values())


@pytest.mark.parametrize(("blocks", "errors"), [(1, []), (8, ["radius_m_error", "detection_0.4m_error"])])
def test_dataframes_have_scalars_and_errors(blocks, errors):
    random = torch.Generator().manual_seed(7)
    metric = CoverageMetric(
        GRID, num_blocks=blocks, regions=[Region("a", GRID.x_m, GRID.y_m), Region("b", (0, 5), (-5, 5))]
    )
    for _ in range(8):
        metric.update(torch.rand(9, 3, generator=random), 10 * torch.rand(60, 3, generator=random))
    result = metric.compute()
    table = result.to_dataframe().set_index(["region", "band"])
    assert {f"{key}/{'/'.join(row)}": value for row, each in table.iterrows() for key, value in each.items()} == {
        key: pytest.approx(value, rel=0, abs=0, nan_ok=True) for key, value in result.scalars().items()
    }
    assert [key for key in table if key.endswith("_error")] == ["radius_m_error", "detection_0.4m_error"][
        : 2 * blocks - 2
    ]


def test_pooled_means_without_a_block_use_other_frames():
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    region, radii = Region("one", grid.x_m, grid.y_m), [3.0, 1.0, 4.0, 1.5, 9.0, 2.0, 6.0, 5.0]
    metric = CoverageMetric(grid, aggregations=[PooledMean()], regions=[region], num_blocks=8)
    for at, radius in enumerate(radii):
        metric.update(torch.tensor([[0.5, 0.5, -radius]]), torch.tensor([[0.5, 0.5, 0.0]]), block_index=at)
    result = metric.compute().estimate_aggregated(region, "all")
    without = [(sum(radii) - radius) / 7 for radius in radii]
    assert result.jackknife_values[:, 0].tolist() == pytest.approx(without)
    assert result.frame_counts.tolist() == [1] * 8


def test_what_was_not_aggregated_has_no_numbers():
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    result = a_coverage(grid=grid, frames=torch.tensor([[[1]]]))
    actual = result.estimate_aggregated(Region("one", grid.x_m, grid.y_m), "all")
    assert (actual.quantities, len(actual.value)) == ((), 0)


def test_repr_shows_the_observed_share():
    grid = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0), cell_m=0.5, heights={"all": (0.0, 1.0)})
    result = a_coverage(grid=grid, frames=torch.tensor([[[1, 0], [0, 0]]]))
    assert repr(result) == "Coverage((1, 2, 2) cells, 3 frames, 25.0% of the cells observed)"


# Files


def assert_same(one, other):
    assert one.grid == other.grid
    assert list(one.grid.heights) == list(other.grid.heights)
    for name in ("thresholds_m", "max_radius_m", "quantities", "counts"):
        assert getattr(one, name) == getattr(other, name), name
    pairs = [(getattr(one, name), getattr(other, name)) for name in ("observed_frames", "point_counts")]
    assert [layer.quantity for layer in one.layers.values()] == [layer.quantity for layer in other.layers.values()]
    pairs += [(layer.values, other.layers[key].values) for key, layer in one.layers.items()]
    assert (one.block_sums is None) == (other.block_sums is None)
    if one.block_sums is not None:
        pairs += [
            (getattr(one.block_sums, name), getattr(other.block_sums, name))
            for name in ("frame_counts", "cell_indices", "denominators", "sums")
        ]
    for a, b in pairs:
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize(
    "options",
    [{}, {"thresholds_m": (), "max_radius_m": math.inf}, {"aggregations": EVERY_AGGREGATION, "num_blocks": 8}],
)
@pytest.mark.parametrize("as_text", [False, True])
def test_a_file_gives_back_what_was_saved(tmp_path, options, as_text):
    heights = {"high": (1.0, 2.0), "low": (-1.0, 0.1)}
    metric = CoverageMetric(
        BevGrid(x_m=(-1, 1), y_m=(0, 0.3), cell_m=0.1, heights=heights), **{"max_radius_m": 2.5, **options}
    )
    metric.update(torch.zeros(1, 3), torch.rand(50, 3, generator=torch.Generator().manual_seed(0)))
    result = metric.compute()
    path = tmp_path / "coverage"  # without a suffix the name does not change
    result.save(str(path) if as_text else path)
    assert path.is_file()
    assert_same(Coverage.load(str(path) if as_text else path), result)


def test_loaded_results_keep_errors_and_comparisons(tmp_path):
    """Loaded results are equal in all bits, since files contain the sums in blocks."""
    random = torch.Generator().manual_seed(3)
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(-2.0, 2.0), cell_m=1.0, heights={"all": (-1.0, 1.0)})
    region, result = Region("all", grid.x_m, grid.y_m), {}
    metrics = {name: CoverageMetric(grid, num_blocks=16) for name in ("a", "b")}
    for _ in range(20):
        reference = torch.rand(40, 3, generator=random) * 4 - torch.tensor([0.0, 2.0, 0.0])
        for metric in metrics.values():
            metric.update(torch.rand(30, 3, generator=random) * 4, reference)
    for name, metric in metrics.items():
        result[name] = metric.compute()
        result[name].save(tmp_path / f"{name}.npz")
    loaded = {name: Coverage.load(tmp_path / f"{name}.npz") for name in result}
    assert repr(loaded["b"].summary([region])) == repr(result["b"].summary([region]))  # NaN differs from NaN
    assert loaded["b"].summary([region])[0].numbers["radius_m"].error > 0
    assert compute_differences(loaded, region, "all") == compute_differences(result, region, "all")
    for key, error in result["a"].errors.items():
        assert torch.equal(loaded["a"].errors[key].nan_to_num(), error.nan_to_num())


def test_a_file_can_be_read_by_numpy_alone(tmp_path):
    result = a_coverage()
    result.save(tmp_path / "coverage.npz")
    with np.load(tmp_path / "coverage.npz") as file:
        header = json.loads(str(file["header"]))
        for key, expected in (("radius_m", result.radius), ("detection_0.8m", result.detection[1])):
            layer = np.full(header["shape"], np.nan)
            layer.flat[file["cell"]] = file[key]
            np.testing.assert_array_equal(layer, expected)
        assert header["grid"]["cell_m"] == 0.5


def test_a_result_survives_pickling():
    assert_same(pickle.loads(pickle.dumps(a_coverage())), a_coverage())


def test_missing_files_are_reported(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.npz: no such file; a saved coverage is needed"):
        Coverage.load(tmp_path / "missing.npz")
    with pytest.raises(IsADirectoryError, match="a folder; a saved coverage is one file"):
        Coverage.load(tmp_path)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "coverage.npz"
    a_coverage(grid=BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=0.5)).save(path)
    return path


NOT_ONE = r"coverage\.npz: (not a coverage file as Coverage\.save writes it \(.+|an empty file)"


@pytest.mark.parametrize("content", [b"", b"hello world", b"PK\x03\x04" + bytes(100), pickle.dumps([1, 2, 3])])
def test_rubbish_is_refused(saved, content):
    saved.write_bytes(content)
    with pytest.raises(ValueError, match=NOT_ONE):
        Coverage.load(saved)


def test_a_damaged_file_is_refused_or_read_right(saved):
    """A cut or a flipped byte anywhere raises the one error, unless the byte has no effect."""
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
    assert [error for error in errors if not re.search(NOT_ONE, error)] == []


def rewrite(path, header=None, **arrays):
    """Save again with another header or other arrays; None removes an array."""
    with np.load(path) as file:
        content = {**dict(file), **arrays}
    if header is not None:
        content["header"] = np.array(header(json.loads(str(content["header"]))))
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


@pytest.mark.parametrize(
    "change",
    [
        {"header": None, "radius_m": None},
        {"header": None, "radius_m": np.zeros((2, 2))},
        {"header": None, "point_counts": np.zeros((2, 2))},
        {"header": lambda _: "[1]"},
        {"header": lambda _: "3"},
        {"header": lambda _: "no JSON"},
        {"header": lambda _: '{"format": 12}'},
        {"header": lambda old: json.dumps({name: value for name, value in old.items() if name != "counts"})},
        {"header": lambda old: json.dumps({**old, "grid": {**old["grid"], "cell_m": 0.7}})},
    ],
)
def test_a_file_with_wrong_parts_is_refused(saved, change):
    rewrite(saved, **change)
    with pytest.raises(ValueError, match=NOT_ONE):
        Coverage.load(saved)


@pytest.fixture
def saved_in_blocks(tmp_path):
    grid = BevGrid(x_m=(0.0, 2.0), y_m=(0.0, 1.0), cell_m=0.5)
    metric = CoverageMetric(grid, num_blocks=8, max_radius_m=9.0, has_area_weights=True)
    for _ in range(8):
        reference = torch.rand(20, 3)
        metric.update(reference[:3], reference, weights=torch.ones(20))
    metric.compute().save(tmp_path / "coverage.npz")
    return tmp_path / "coverage.npz"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"header": lambda old: json.dumps({**old, "num_blocks": 10**9})},
            "the frame counts of 1000000000 blocks have shape",
        ),
        ({"header": lambda old: json.dumps({**old, "num_blocks": -8})}, "the frame counts of -8 blocks have shape"),
        ({"cell": lambda old: old[1:]}, "observed_frames has shape"),
        ({"cell": lambda old: old[::-1]}, "cell: cell indices in ascending order, below 16, are needed"),
        ({"block_cell": lambda old: old.astype(np.int64) - 1000}, "block_cell: cell indices in ascending order"),
        ({"area_cell": lambda old: old + 8 * 16}, "area_cell: cell indices in ascending order, below 128"),
        ({"area_cell": lambda old: old[1:]}, "cells do not fit into"),
        ({"block_sums": lambda old: old[:, :1]}, "cells do not fit into"),
        ({"block_cell": lambda old: old[::-1]}, "block_cell: cell indices in ascending order"),
        ({"area_cell": lambda old: np.repeat(old[::2], 2)[: len(old)]}, "area_cell: cell indices in ascending"),
    ],
)
def test_blocks_that_do_not_fit_are_refused(saved_in_blocks, change, message):
    Coverage.load(saved_in_blocks)
    with np.load(saved_in_blocks) as file:
        arrays = {name: make(file[name]) for name, make in change.items() if name != "header"}
    rewrite(saved_in_blocks, header=change.get("header"), **arrays)
    with pytest.raises(BadFileError, match=rf"coverage\.npz: .*{message}"):
        Coverage.load(saved_in_blocks)


def test_empty_blocks_count_as_memory(saved_in_blocks, monkeypatch):
    """A million blocks take kilobytes in a file, yet errors need all observed cells in all blocks."""
    many = np.zeros(1_000_000, np.int64)
    rewrite(
        saved_in_blocks,
        lambda old: json.dumps({**old, "num_blocks": len(many)}),
        block_frame_counts=many,
        area_frame_counts=many,
    )
    monkeypatch.setenv("TORCHCOVER_MAX_FILE_GB", "0.1")
    with pytest.raises(BadFileError, match=r"coverage\.npz: reading it takes 0\.\d+ GB .* more than the 0\.1 GB"):
        Coverage.load(saved_in_blocks)


def test_an_array_file_is_no_coverage_file(saved):
    with saved.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(ValueError, match=NOT_ONE):
        Coverage.load(saved)


@pytest.mark.parametrize(("number", "then"), [(11, "; evaluate the recording or scenario again"), (13, "$")])
def test_another_format_is_refused_by_its_number(saved, number, then):
    rewrite(saved, header=lambda old: json.dumps({**old, "format": number, "unheard of": 1}))
    said = rf"coverage\.npz: coverage format {number}; this torchcover reads format 12{then}"
    with pytest.raises(ValueError, match=said):
        Coverage.load(saved)


def test_torch_loads_results_with_weights_only():
    """Load as Lightning does for hyperparameters in checkpoints."""
    grid, region = BevGrid(x_m=(0.0, 1.0), y_m=(0.0, 1.0)), Region("a", x_m=(0.0, 1.0), y_m=(0.0, 1.0))
    options = {
        "num_blocks": 8,
        "has_area_weights": True,
        "sensor_names": ("a",),
        "aggregations": (Maximum(), PooledMean()),
    }
    metric = CoverageMetric(grid, max_radius_m=5.0, regions=[region], **options)
    clouds = torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    for _ in range(9):
        metric.update({"a": clouds}, clouds, weights=torch.ones(5))
    boxes = Boxes.from_rows(torch.tensor([[1.0, 0, 0, 4, 2, 2, 0]]))
    frame = Frame(
        {"a": clouds},
        clouds,
        index=np.int64(3),
        name="a",
        boxes=boxes,
        measurements={"a": Measurement(clouds, clouds[:, 0])},
    )
    seen = measure_box_visibility(clouds, clouds, boxes, reference_weights=None)
    stream = io.BytesIO()
    torch.save([grid, region, metric.compute(), frame, collate_frames([frame]), seen], stream)
    stream.seek(0)
    loaded = torch.load(stream, weights_only=True)
    assert loaded[:2] == [grid, region]
    assert loaded[2].scalars() == pytest.approx(metric.compute().scalars(), rel=0, abs=0, nan_ok=True)
    assert torch.equal(loaded[3].boxes.rows, boxes.rows)
    assert loaded[4].block_indices == [3]
