"""The functions that torch leaves to MKL are called by one thread before several call them."""

import json
import subprocess
import sys

import pytest

SAID = """
import json, torch
seen = []

def watched(name):
    function = getattr(torch, name)
    def call(values, *args, **kwargs):
        seen.append((name, str(values.dtype), values.numel()))
        return function(values, *args, **kwargs)
    return call

for name in ("sqrt", "sin", "cos", "exp", "log"):
    setattr(torch, name, watched(name))
import {module}
print(json.dumps(seen))
"""


@pytest.mark.parametrize(
    "module",
    [
        "torchcover.cameras.camera",
        "torchcover.contrib.ratio_metrics",
    ],
)
def test_first_calls_precede_threads_and_forks(module):
    code = SAID.format(module=module)
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    made = {(name, dtype): numbers for name, dtype, numbers in json.loads(said.stdout)[:10]}
    functions = ("sqrt", "sin", "cos", "exp", "log")
    assert made == {(name, f"torch.{dtype}"): 1 for name in functions for dtype in ("float32", "float64")}
