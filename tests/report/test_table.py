"""The table: what is in it, which numbers are the best, and that no rig's place in it matters to the others."""

import math
from itertools import permutations

import pytest
import torch

from torchcover.coverage import BevGrid, CoverageMetric, Region, compute_differences
from torchcover.report import CoverageTable, collect_table_notes


def names(table: CoverageTable, rig: str) -> set[str]:
    return {remark.name for remark in collect_table_notes(table, rig)}


def test_a_table_has_the_summaries_of_its_coverages(trio, regions):
    table = CoverageTable.from_coverages(trio, regions, ["by hand"])
    assert (table.rigs, table.notes, table.grid) == (("few", "other", "many"), ("by hand",), trio["few"].grid)
    for rig, coverage in trio.items():
        # As text, for NaN is not equal to itself.
        assert str([row.summary for row in table.rows[rig]]) == str(coverage.summary(regions))
        assert table.conditions[rig].counts == coverage.counts
        assert (table.conditions[rig].blocks, table.conditions[rig].frames_per_block) == (12, 2)
    assert [[row.rig for row in rows] for rows in table.rows_by_region] == [list(table.rigs)] * 4


def test_differences_are_the_paired_ones_of_the_coverage(trio, regions):
    table = CoverageTable.from_coverages(trio, regions)
    for rows in table.rows_by_region:
        expected = compute_differences(trio, rows[0].region, rows[0].summary.band)
        assert str({row.rig: row.differences for row in rows}) == str(expected)


def test_one_rig_has_neither_marks_nor_differences(trio, regions):
    for (row,) in CoverageTable.from_coverages({"few": trio["few"]}, regions).rows_by_region:
        assert not row.leading_keys
        assert not row.differences


def test_rig_order_changes_no_number(trio, regions):
    expected = CoverageTable.from_coverages(trio, regions)
    for order in permutations(trio):
        table = CoverageTable.from_coverages({rig: trio[rig] for rig in order}, regions)
        assert table.rigs == order
        for rig in order:
            for row, same in zip(table.rows[rig], expected.rows[rig], strict=True):
                assert str(row.summary) == str(same.summary)
                assert row.leading_keys == same.leading_keys


def test_equal_rigs_have_no_marks(measure, points, regions):
    one = measure(points(50, 1), thresholds_m=(0.4, 1.0))
    table = CoverageTable.from_coverages({"a": one, "b": one}, regions)
    for rows in table.rows.values():
        for row in rows[:2]:
            assert not row.leading_keys
            assert [difference.value for difference in row.differences.values()] == [0.0] * 3


def test_the_unknown_never_wins(pair, regions):
    for rows in CoverageTable.from_coverages(pair, regions).rows.values():
        for row in rows[2:]:
            assert row.summary.region == "behind"
            assert math.isnan(row.summary.numbers["radius_m"].value)
            assert math.isnan(row.differences["radius_m"].value)
            assert not row.leading_keys


def test_two_blind_rigs_are_equal_not_unknown(blind, regions):
    rows = {rig: rows[0] for rig, rows in CoverageTable.from_coverages(blind, regions).rows.items()}
    assert rows["[blind]"].summary.numbers["radius_m"].value == math.inf
    assert rows["[blind]"].differences["radius_m"].value == 0.0
    assert rows["seeing"].differences["radius_m"].value == -math.inf
    assert not any(row.leading_keys for row in rows.values())


def test_only_significant_leads_are_marked(trio, regions):
    table = CoverageTable.from_coverages(trio, regions)
    for rows in table.rows_by_region[:2]:
        for key in ("radius_m", "detection_0.4m"):
            each = {row.rig: trio[row.rig].estimate(row.region, row.summary.band) for row in rows}
            ahead = [each["many"].compute_differences(each[other])[key].is_significant for other in ("few", "other")]
            assert [key in row.leading_keys for row in rows] == [False, False, all(ahead)]
            assert all(ahead)
    # Far ahead of the last is not ahead of the next.
    tied = CoverageTable.from_coverages({**trio, "again": trio["many"]}, regions)
    assert not any(row.leading_keys for rows in tied.rows_by_region for row in rows)


def test_remarks_are_made_of_what_did_happen_only(blind, trios, regions):
    table = CoverageTable.from_coverages(blind, regions)
    assert "empty_sensor_frames" not in names(table, "seeing")
    (remark,) = [remark for remark in collect_table_notes(table, "blind") if remark.name == "empty_sensor_frames"]
    assert (remark.count, remark.total) == (1, 1)
    assert "unobserved_cells" in names(table, "seeing")
    assert names(CoverageTable.from_coverages({"few": trios(5)["few"]}, ()), "few") == {"no_region", "too_few_blocks"}


def test_fully_observed_tables_have_no_notes():
    grid = BevGrid(x_m=(0.0, 4.0), y_m=(0.0, 2.0), cell_m=1.0, heights={"ground": (-0.5, 0.5)})
    metric = CoverageMetric(grid)
    metric.update(torch.zeros(1, 3), torch.cartesian_prod(torch.arange(4) + 0.5, torch.arange(2) + 0.5, torch.zeros(1)))
    table = CoverageTable.from_coverages({"full": metric.compute()}, [Region("all", grid.x_m, grid.y_m)])
    assert not collect_table_notes(table, "full")


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"seed": 7}, "different reference points"),
        ({"thresholds_m": (0.5,)}, "differ in their thresholds"),
        ({"max_radius_m": 9.0}, "differ in their max_radius"),
        ({"grid": BevGrid(x_m=(0.0, 10.0), y_m=(-5.0, 5.0), cell_m=1.0)}, "differ in their grid"),
    ],
)
def test_coverages_that_are_not_paired_are_refused(measure, points, regions, other, message):
    unpaired = {"a": measure(points(9, 1)), "b": measure(points(9, 1), **other)}
    with pytest.raises(ValueError, match=f"'a' and 'b' cannot be compared: .*{message}"):
        CoverageTable.from_coverages(unpaired, regions)


def test_what_makes_no_table_is_refused(pair):
    with pytest.raises(ValueError, match="at least one rig"):
        CoverageTable.from_coverages({}, ())
    with pytest.raises(ValueError, match="beyond the grid's"):
        CoverageTable.from_coverages(pair, [Region("wide", x_m=(0.0, 99.0), y_m=(0.0, 2.0))])
