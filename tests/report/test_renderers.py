"""Renderers: whatever a table is written as, it says the same."""

import csv
import io
import json
import math
import re

import pytest

from torchcover.report import (
    BOLD_MARKS,
    RENDERERS,
    CoverageTable,
    TextCell,
    build_page_tables,
    build_table_dict,
    explain_marks,
    list_notes,
    to_json_record,
)


@pytest.fixture(params=["one rig", "one rig, no errors", "two rigs", "three rigs", "infinite", "no region"])
def table(request, trio, pair, blind, regions):
    """Tables of every kind."""
    of = {
        "one rig": {"few": trio["few"]},
        "one rig, no errors": {"few": pair["few"]},
        "two rigs": pair,
        "three rigs": trio,
        "infinite": blind,
        "no region": trio,
    }
    return CoverageTable.from_coverages(of[request.param], () if request.param == "no region" else regions)


def csv_rows(table: CoverageTable) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(RENDERERS["csv"](table))))


def json_of(table: CoverageTable) -> dict:
    def forbid(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(RENDERERS["json"](table), parse_constant=forbid)


def text_cells(table: CoverageTable) -> list[list[str]]:
    lines = [line for line in RENDERERS["text"](table).splitlines() if line.startswith("│")]
    return [[re.sub(r"^[*!] ", "", cell.strip()) for cell in line.strip("│").split("│")] for line in lines]


def markdown_lines(text: str) -> list[list[str]]:
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in rows]


def markdown_cells(table: CoverageTable) -> list[list[str]]:
    rows = markdown_lines(RENDERERS["markdown"](table))
    body = [row for row in rows if row[:2] not in (["region", "band"], ["---", "---"])]
    return [[re.sub(r"\\(?=[^\w\s])", "", cell.strip("*")) for cell in row] for row in body]


def as_field(value: object) -> str:
    """What CSV makes of a number of JSON."""
    return "" if value is None else str(float(value) if value in ("Infinity", "-Infinity") else value)


def test_csv_and_json_match_the_table(table):
    rows = json_of(table)["rows"]
    assert csv_rows(table) == [{name: as_field(value) for name, value in row.items()} for row in rows]
    for record, row in zip(rows, [row for rows in table.rows.values() for row in rows], strict=True):
        assert (record["rig"], record["region"], record["band"]) == (row.rig, row.region.name, row.summary.band)
        assert (record["observed_cells"], record["observed_share"]) == (
            row.summary.observed_cells,
            row.summary.observed_share,
        )
        for key, number in row.summary.numbers.items():
            expected = to_json_record({part: getattr(number, part) for part in ("value", "error", "low", "high")})
            assert [record[key], *(record[f"{key}_{part}"] for part in ("error", "low", "high"))] == [
                *expected.values()
            ]
        for key, difference in row.differences.items():
            expected = to_json_record(difference._asdict())
            assert record[f"{key}_difference"] == expected["value"]
            for part in ("error", "low", "high"):
                assert record[f"{key}_difference_{part}"] == expected[part]
            assert record[f"{key}_difference_significant"] is difference.is_significant
            assert record[f"{key}_best"] is (key in row.leading_keys)


def test_text_and_markdown_have_equal_cells(table):
    parts = [[cell.text for cell in row] for part in build_page_tables(table) for row in part.rows]
    assert text_cells(table) == parts
    assert markdown_cells(table) == [[cell.replace("  ", " ") for cell in row] for row in parts]


def test_marked_cells_are_bold_in_markdown(trio, regions):
    table = CoverageTable.from_coverages(trio, regions)
    signs = re.findall(r"│ +([*!]) ", RENDERERS["text"](table))
    bold = re.findall(r"\*\*[^*]+\*\*", RENDERERS["markdown"](table))
    marks = [cell.mark for part in build_page_tables(table) for row in part.rows for cell in row if cell.mark]
    assert len(bold) == len(marks) > 4
    assert signs == [{"best": "*", "significant": "!"}[mark] for mark in marks]
    assert set(marks) == {"best", "significant"}


def test_no_renderer_calls_anything_nan(table):
    for render in RENDERERS.values():
        assert "nan" not in render(table).lower()


def test_several_rigs_only_add_columns(trio, regions):
    one, three = (list(csv_rows(CoverageTable.from_coverages(of, regions))[0]) for of in ({"few": trio["few"]}, trio))
    assert three[: len(one)] == one
    assert one[:5] == ["rig", "region", "band", "radius_m", "radius_m_error"]
    numbers = ("difference", "difference_error", "difference_low", "difference_high")
    names = ("best", *numbers, "difference_significant")
    assert three[len(one) :] == [f"{key}_{name}" for key in ("radius_m", "detection_0.4m") for name in names]


def test_without_regions_csv_still_has_its_header(trio, regions):
    headers = {RENDERERS["csv"](CoverageTable.from_coverages(trio, places)).splitlines()[0] for places in ((), regions)}
    assert len(headers) == 1
    assert headers.pop().startswith("rig,region,band,radius_m,")


def test_files_hold_the_bounds_and_the_blocks(trio, regions):
    table = CoverageTable.from_coverages(trio, regions)
    row = csv_rows(table)[3]
    assert [float(row[f"{axis}_{end}_m"]) for axis in "xyz" for end in ("min", "max")] == [-8, -6, -5, 5, 0.5, 2]
    assert (row["num_frames"], row["blocks"], row["frames_per_block"], row["cell_m"]) == ("24", "12", "2", "1.0")
    content = json_of(table)
    assert (content["blocks"], content["frames_per_block"], content["thresholds_m"]) == (12, 2, [0.4])
    assert content["grid"] == {
        "x_m": [-8.0, 12.0],
        "y_m": [-5.0, 5.0],
        "cell_m": 1.0,
        "heights_m": {"ground": [-0.5, 0.5], "obstacle": [0.5, 2.0]},
    }
    assert content["counts"] == {rig: coverage.counts for rig, coverage in trio.items()}
    assert json_of(CoverageTable.from_coverages({"few": trio["few"]}, regions))["counts"] == trio["few"].counts


def test_without_blocks_there_are_none_in_files(pair, regions):
    content = build_table_dict(CoverageTable.from_coverages(pair, regions))
    assert (content["blocks"], content["frames_per_block"]) == (None, None)
    assert {row["radius_m_error"] for row in content["rows"]} == {None}


def test_infinity_survives_json_and_is_not_unknown(blind, regions):
    content = json_of(CoverageTable.from_coverages(blind, regions))
    assert float(content["max_radius_m"]) == float(content["rows"][0]["radius_m"]) == math.inf
    assert content["rows"][2]["radius_m"] is None


def test_markup_in_names_is_escaped(trio, regions):
    names = ["a|b", "[bold]:car:[/bold]", "_x_*y* `z` <b> &amp; \\"]
    table = CoverageTable.from_coverages(dict(zip(names, trio.values(), strict=True)), regions)
    text, markdown = RENDERERS["text"](table), RENDERERS["markdown"](table)
    assert all(name in text for name in names)
    rows = markdown_lines(markdown)
    parts = build_page_tables(table)  # of which those of the differences to the first rig have a column less
    assert {len(row) for row in rows} == {len(part.headings) for part in parts}
    assert len({len(part.headings) for part in parts}) == 2
    assert rows[0][2:5] == [r"a\|b", r"\[bold\]:car:\[/bold\]", r"\_x\_\*y\* \`z\` \<b> \&amp; \\"]
    assert [row["rig"] for row in csv_rows(table)[::4]] == names


def test_plain_names_are_unchanged_in_markdown(trio, regions):
    table = CoverageTable.from_coverages({"front_roof_128": trio["few"], "it's 5 < 6 & more": trio["many"]}, regions)
    assert "| front_roof_128 | it's 5 < 6 & more |" in RENDERERS["markdown"](table)


def test_notes_of_the_caller_are_rendered(trio, regions):
    table = CoverageTable.from_coverages(trio, regions, ["Reference sensor: a cat."])
    assert "Reference sensor: a cat." in RENDERERS["text"](table)
    assert "* Reference sensor: a cat." in RENDERERS["markdown"](table)


def test_custom_renderer_needs_only_public_names(trio, regions):
    def as_html(table: CoverageTable) -> str:
        cells = ("<td>{}</td>".format(f"<b>{cell.text}</b>" if cell.mark else cell.text) for cell in cells_of(table))
        legend = [f"{BOLD_MARKS[mark]}: {meaning}" for mark, meaning in explain_marks(table).items()]
        return "".join([*cells, *(f"<li>{note}</li>" for note in (*legend, *list_notes(table)))])

    def cells_of(table: CoverageTable) -> list[TextCell]:
        return [cell for part in build_page_tables(table) for row in part.rows for cell in row]

    table = CoverageTable.from_coverages(trio, regions)
    html = as_html(table)
    assert html.count("<td>") == len(cells_of(table))
    assert html.count("<b>") == sum(bool(cell.mark) for cell in cells_of(table)) > 4
    assert html.count("<li>") == len(list_notes(table)) + len(BOLD_MARKS)
    assert "<li>In bold among the differences: significant" in html


@pytest.mark.parametrize(("steps", "explained"), [(4, False), (24, True)])
def test_significance_mark_is_explained_with_errors(trios, regions, steps, explained):
    assert ("significant" in explain_marks(CoverageTable.from_coverages(trios(steps), regions))) is explained
