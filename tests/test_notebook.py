"""Notebook test: the notebook of the documentation runs, and its stored outputs have the kinds of a new run."""

import copy
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]


def list_output_types(notebook):
    """List the MIME types of the outputs of each cell, without printed messages."""
    output_types = []
    for cell in notebook.cells:
        outputs = [output for output in cell.get("outputs", []) if output.output_type != "stream"]
        output_types.append([sorted(output.get("data", {})) for output in outputs])
    return output_types


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of nbclient
def test_notebook_runs_and_its_stored_outputs_match():
    stored = nbformat.read(ROOT / "docs" / "notebook.ipynb", as_version=4)
    executed = copy.deepcopy(stored)
    NotebookClient(executed, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(ROOT)}}).execute()
    assert list_output_types(executed) == list_output_types(stored)
    assert sum(map(bool, list_output_types(stored))) >= 5
