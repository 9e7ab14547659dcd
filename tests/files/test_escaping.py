"""Foreign names are displayed without side effects."""

import csv
import io

import pytest

from torchcover.files import escape_control_chars, format_csv, read_csv
from torchcover.report import Terminal

NASTY = (
    "=1+1",
    "+cmd|' /C calc'!A0",
    "-2+3",
    "@SUM(A1)",
    "\tx",
    "\x1b]0;title\x07",
    "a\x9bb",
    "\u202egnp.exe",
    "'=quoted",
)


@pytest.mark.parametrize("name", NASTY)
def test_names_are_no_formulas_and_no_control_codes(name):
    ((cell,),) = csv.reader(io.StringIO(format_csv([[name]])))
    assert cell[0] not in "=+-@\t\r"
    assert all(letter.isprintable() or letter == "\t" for letter in cell)


def test_numbers_stay_numbers():
    values = [-1.5, 3, "-0.25", "+1e-9", "-inf", None, float("nan"), "roof", "front left", "ü"]
    ((*cells,),) = csv.reader(io.StringIO(format_csv([values])))
    assert cells == ["-1.5", "3", "-0.25", "+1e-9", "-inf", "", "", "roof", "front left", "ü"]


def test_names_like_formulas_survive_a_round_trip(tmp_path):
    names = ["=1+1", "-x", "'plain'", "'=quoted", "car"]
    path = tmp_path / "names.csv"
    path.write_text(format_csv([["name"], *([name] for name in names)]), encoding="utf-8")
    assert read_csv(path, (), ["name"]).texts["name"] == names


def test_terminals_show_control_characters(capsys):
    terminal = Terminal(width=60, force_terminal=True)
    terminal.print("roof\x1b[2J\x1b]0;mine\x07", markup=False, highlight=False)
    terminal.print("two\nlines\x9b", highlight=False)
    assert "\\x1b[2J\\x1b]0;mine" in (printed := capsys.readouterr().out)
    assert "two\nlines\\x9b" in printed
    assert escape_control_chars("two\nlines, ü, 車") == "two\nlines, ü, 車"
    with terminal.status("opening"):  # escape codes of rich hide the cursor
        pass
    assert "\x1b[?25l" in capsys.readouterr().out
