"""Isolated readers whose libraries misbehave."""

import ctypes
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

from torchcover.files.isolated import run_isolated


@run_isolated
def good(path: Path, factor: float):
    return {"numbers": factor * np.arange(6.0).reshape(2, 3), "words": np.array(["a", path.name], dtype=object),
            "none": np.empty((0, 3), np.float32), "one": np.array(7, np.int8)}  # fmt: skip


@run_isolated
def loud(path: Path):
    sys.stdout.write("library: hello\n")
    os.write(1, b"from below")
    return {"process": np.array([os.getpid(), "torch" in sys.modules])}


@run_isolated
def wrong(path: Path, kind: str):
    if kind == "module":
        import no_such_package  # noqa: F401
    raise {"value": ValueError, "key": KeyError, "import": ImportError}[kind]("said")


@run_isolated
def crashing(path: Path):
    ctypes.string_at(0)
    return {}


@run_isolated
def hanging(path: Path):
    time.sleep(60)
    return {}


@run_isolated
def greedy(path: Path, gb: float):
    return {"bytes": np.ones(int(gb * 1e9), np.uint8)[:1]}


KEPT = []


@run_isolated
def keeping(path: Path, gb: float):
    KEPT.append(np.ones(int(gb * 1e9), np.uint8))
    return {"kept": np.array([len(KEPT), os.getpid()])}


@run_isolated
def writing(path: Path):
    path.with_suffix(".new").write_text("x")
    return {}


@run_isolated
def stopping(path: Path):
    os.kill(os.getpid(), signal.SIGSTOP)
    return {"one": np.array(1)}
