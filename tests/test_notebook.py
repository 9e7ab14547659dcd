"""The notebook of the documentation runs from its first cell to its last, and shows what it is kept with."""

import copy
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]


def kinds(notebook):
    """Of each cell, what kinds of output it has, without what is only said on the way."""
    shown = [[each for each in cell.get("outputs", []) if each.output_type != "stream"] for cell in notebook.cells]
    return [[sorted(each.get("data", {})) for each in outputs] for outputs in shown]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of what runs notebooks, about itself
def test_the_notebook_runs_and_shows_what_it_is_kept_with():
    kept = nbformat.read(ROOT / "docs" / "notebook.ipynb", as_version=4)
    run = copy.deepcopy(kept)
    NotebookClient(run, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}}).execute()
    assert kinds(run) == kinds(kept)
    assert sum(map(bool, kinds(kept))) >= 5
