"""No sentence says what may be chance, and each number in it is one of the table."""

import math
import re
from dataclasses import replace

import pytest
import torch

from torchcover.coverage import BevGrid, CoverageMetric, Region
from torchcover.report import CoverageTable, summarize_findings
from torchcover.report.sensor_failures import describe_single_point_of_failure
from torchcover.report.table import Row

AHEAD = (Region("near", (0.0, 4.0), (-5.0, 5.0)), Region("far", (0.0, 12.0), (-5.0, 5.0)),
         Region("behind", (-8.0, -6.0), (-5.0, 5.0)))  # fmt: skip


def with_bodies(table, shares, best=None, places=30):
    """The table with a child beside the vehicle: its rows of detection stand for the share of places."""
    key = table.mean_quantities[1].key
    bodies = {}
    for rig, share in shares.items():
        row = table.rows[rig][0]
        number = row.summary.numbers[key]._replace(value=share, count=places)
        if len(shares) == 1 and share in (0.0, 1.0):  # all blocks say so
            number = number._replace(error=math.nan, low=math.nan, high=math.nan)
        summary = replace(row.summary, region="front_3m", band="child_110cm", numbers={key: number})
        bodies[rig] = (Row(rig, Region("front_3m", (2.0, 5.0), (-1.0, 1.0)), summary,
                           frozenset({key} if rig == best else ()), {}),)  # fmt: skip
    return replace(table, target_rows=bodies)


def test_one_rig_reports_the_farthest_forward_region(trio):
    (sentence,) = summarize_findings(CoverageTable.from_coverages({"few": trio["few"]}, AHEAD))
    assert sentence.startswith("Detected to 12 m ahead (a point within 0.4 m): of 120 observed cells of ground ")
    table = CoverageTable.from_coverages({"few": trio["few"]}, AHEAD)
    rows = [row for row in table.rows["few"] if row.region is AHEAD[1]]
    told = [int(number) for number in re.findall(r"(\d+) % \[(?:\d+), (?:\d+)\]", sentence)]
    assert told == [round(100 * row.summary.numbers[table.mean_quantities[1].key].value) for row in rows]


def test_several_rigs_report_only_significant_leaders(trio):
    table = CoverageTable.from_coverages({name: trio[name] for name in ("few", "many")}, AHEAD)
    (sentence,) = summarize_findings(table)
    assert re.search(
        r"ground many \d+ %, few \d+ %; of 120 observed cells of obstacles many \d+ %, few \d+ %", sentence
    )
    (sentence,) = summarize_findings(
        CoverageTable.from_coverages({name: trio[name] for name in ("few", "other")}, AHEAD)
    )
    assert sentence == "No rig detects significantly more than the others to 12 m ahead (a point within 0.4 m)."


def test_without_errors_nothing_is_told(pair, blind, trios, regions):
    for coverages in (pair, blind, {"few": pair["few"]}):
        assert summarize_findings(CoverageTable.from_coverages(coverages, AHEAD)) == ()
    (sentence,) = summarize_findings(CoverageTable.from_coverages(trios(4), AHEAD))
    assert sentence == (
        "Not enough frames for an answer: 4 frames form 4 blocks, 9 are needed (about 9 frames; `--num-frames`)."
    )
    assert summarize_findings(CoverageTable.from_coverages(pair, regions[1:])) == ()


@pytest.mark.parametrize("frames", [2, 6, 11, 21, 24])
def test_the_advised_number_of_frames_gives_intervals(points, frames):
    """Blocks of three frames, in which the reference sees more or less: 8 of them count as fewer."""

    def table_of(count):
        metric = CoverageMetric(
            BevGrid(x_m=(-8.0, 12.0), y_m=(-5.0, 5.0), cell_m=1.0), num_blocks=16, has_area_weights=True
        )
        for index in range(count):
            m2 = torch.full((100,), 0.2 + 0.8 * (index % 5 > 1))
            metric.update(points(40, index), points(100, 1000 + index), weights=m2, block_index=index // 3)
        return CoverageTable.from_coverages({"one": metric.compute()}, AHEAD, block_ends=range(3, 300, 3))

    table = table_of(frames)
    (sentence,) = summarize_findings(table)
    assert sentence.startswith(f"Not enough frames for an answer: {frames} frames form {-(-frames // 3)} block")
    advised = int(re.search(r"about (\d+) frames", sentence)[1])
    assert not table.has_intervals
    assert 24 < advised <= 40
    for row in table_of(advised).rows["one"]:
        number = row.summary.numbers[table.mean_quantities[1].key]
        assert math.isnan(number.low) == math.isnan(number.value) == (row.region is AHEAD[2])
    visible_m2 = next(row.summary.visible_m2 for row in table_of(advised).rows["one"] if row.region is AHEAD[1])
    assert (
        f"(a point within 0.4 m): of {visible_m2:,.1f} m² of visible ground" in summarize_findings(table_of(advised))[0]
    )
    short = replace(table, block_ends=(3, 6, 7))
    assert summarize_findings(short)[0].endswith("and the source has 3.")


CHILD = "where a child is detected (detection within 0.4 m): "


@pytest.mark.parametrize(
    ("shares", "best", "sentence"),
    [
        ({"many": 0.997}, None, f"Free positions within 3 m {CHILD}in front 99 % ["),
        ({"many": 0.0}, None, f"Free positions within 3 m {CHILD}in front 0 %."),
        ({"many": 1.0}, None, f"Free positions within 3 m {CHILD}in front 100 %."),
        ({"few": 0.004, "many": 1.0}, "many", f"{CHILD}in front many 100 %, few 1 %."),
        ({"few": 0.5, "many": 0.6}, None, f"{CHILD}no rig has significantly more than"),
    ],
)
def test_bodies_come_first(trio, shares, best, sentence):
    table = with_bodies(CoverageTable.from_coverages({name: trio[name] for name in shares}, AHEAD), shares, best)
    first, *_ = summarize_findings(table)
    assert sentence in first


def test_few_agreeing_positions_are_not_reported(trio):
    table = CoverageTable.from_coverages({"many": trio["many"]}, AHEAD)
    for places, told in ((29, False), (30, True)):
        words = " ".join(summarize_findings(with_bodies(table, {"many": 1.0}, places=places)))
        assert ("where a child is detected (detection within 0.4 m): in front 100 %" in words) == told


INSIGNIFICANT = "No single point of failure: no failure of a sensor changes a number significantly by 10 % or more"
CHANGE = "detection within 0.01 m in near ground changes from "


@pytest.mark.parametrize(
    ("count_roof_points", "blocks", "sentence"),
    [
        (lambda index: 30 + index % 2, 16, f"Single point of failure: roof; without it, {CHANGE}"),
        (lambda index: 5 + index % 2, 16, INSIGNIFICANT),
        (lambda index: 40 * (index < 3), 16, INSIGNIFICANT),
        (lambda index: 30 + index % 2, 4, f"Largest effect of a failure: without roof, {CHANGE}"),
    ],
)
def test_single_point_of_failure_loses_a_tenth_significantly(count_roof_points, blocks, sentence):
    """Of 100 points, both sensors detect 60, and the roof sensor alone some of the others."""
    grid = BevGrid(x_m=(-8.0, 12.0), y_m=(-5.0, 5.0), cell_m=1.0)
    metric = CoverageMetric(
        grid, (0.01,), num_blocks=16, regions=AHEAD[:1], has_area_weights=True, sensor_names=("roof", "rear")
    )
    for index in range(blocks):
        reference = torch.rand(100, 3, generator=torch.Generator().manual_seed(index)) * torch.tensor([4.0, 4.0, 0.2])
        seen = {"roof": reference[: 60 + count_roof_points(index)], "rear": reference[:60]}
        metric.update(seen, reference, weights=torch.full((100,), 0.1), block_index=index)
    table = CoverageTable.from_coverages({"rig": metric.compute()}, AHEAD[:1])
    assert describe_single_point_of_failure(table, "rig").startswith(sentence)
    assert any(words.startswith(sentence) for words in summarize_findings(table))
