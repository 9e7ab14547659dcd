"""Libraries that are not Python read in a process of their own: a damaged file ends that one, and not the run.

The process is a plain one that imports no torch, reads file after file for as long as its parent lives, and has limits
of memory, time and open files for each. What goes through the connection is JSON and the bytes of arrays.
"""

import atexit
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from importlib import import_module
from inspect import unwrap
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

from torchcover.files.bad_file import LIBRARIES_GB, VARIABLE, BadFileError, check_memory, find_memory_limit_gb
from torchcover.files.processes import (
    end_with_parent,
    get_used_bytes,
    is_stopped,
    limit_resources,
    report_stopped_processes,
)

Arguments = ParamSpec("Arguments")
Arrays = dict[str, NDArray[Any]]
Reader = Callable[Concatenate[Path, Arguments], Arrays]

MOST_S = 60.0  # for a file, and a second more for each megabyte
BYTES_PER_S = 1e6
KNOWN_ERRORS = {kind.__name__: kind for kind in (BadFileError, ValueError, MemoryError, ImportError, FileNotFoundError)}
# The same modules as here, whatever folder this one was started in.
PROGRAM = "import sys; sys.path[:] = {path!r}; from torchcover.files.isolated import serve_requests; serve_requests()"


def run_isolated(read: Reader[Arguments]) -> Reader[Arguments]:
    """Let a function of a module without torch do its work in the process for such files.

    Args:
        read: It gets the path, and what JSON can carry; it returns arrays by name. A `ValueError`, `MemoryError`,
            `ImportError` or `FileNotFoundError` of it is raised here, anything else as a `ValueError` with its name.

    Returns:
        The same function. It raises a ValueError, too, if the process crashes or takes longer than 60 s and a second a
        megabyte.
    """

    @wraps(read)
    def asked(path: Path, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Arrays:
        assert not kwargs
        files = path.iterdir() if path.is_dir() else [path]
        limit_s = MOST_S + sum(file.stat().st_size for file in files) / BYTES_PER_S
        request = [os.environ.get(VARIABLE), read.__module__, read.__name__, str(path.absolute()), *args]
        return _own_process().ask(request, limit_s)

    return asked  # type: ignore[return-value]  # which would have the path without a name


class _Process:
    """One that reads."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._connection, other = Pipe()
        with other:
            self.popen = subprocess.Popen(
                [sys.executable, "-c", PROGRAM.format(path=sys.path)],
                stdin=other.fileno(),
                stdout=subprocess.DEVNULL,  # a library that prints must not answer
                stderr=subprocess.DEVNULL,  # where OpenEXR says what is wrong
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                preexec_fn=end_with_parent(),  # noqa: PLW1509  (it calls prctl only)
            )

    def ask(self, request: list[Any], limit_s: float) -> Arrays:
        with self.lock, report_stopped_processes([self.popen.pid], "the process that reads files"):
            try:
                self._connection.send_bytes(json.dumps(request).encode())
                answer, arrays = _receive(self._connection, limit_s)
            except (ConnectionError, EOFError, TimeoutError) as error:
                late, stopped = isinstance(error, TimeoutError), is_stopped(self.popen.pid)
                self.end()
                if stopped:
                    reason = f"the process that reads it was stopped for {limit_s:.0f} s; read it again"
                    raise ValueError(reason) from error
                ended = f"it took more than {limit_s:.0f} s" if late else "the library that reads it crashed"
                raise ValueError(f"{ended}; the file is damaged, or not what its name says") from error
            except BaseException:  # such as Ctrl-C: an answer that nobody waits for must not be the next one's
                self.end()
                raise
        if answer is not None:
            name, words = answer
            raise KNOWN_ERRORS[name](words) if name in KNOWN_ERRORS else ValueError(words)
        return arrays

    def end(self) -> None:
        self.popen.kill()
        self._connection.close()
        self.popen.wait()


def _receive(connection: Connection, limit_s: float) -> tuple[list[str] | None, Arrays]:
    if not connection.poll(limit_s):
        raise TimeoutError
    error, listed = json.loads(connection.recv_bytes())
    arrays = {name: np.empty(shape, dtype) for name, dtype, shape in listed}
    with open(connection.fileno(), "rb", closefd=False) as pipe:
        for array in arrays.values():
            if pipe.readinto(array.reshape(-1).view(np.uint8).data) < array.nbytes:
                raise EOFError
    return error, arrays


_processes: dict[int, _Process] = {}
_starting = threading.Lock()


def _own_process() -> _Process:
    """That of this process: a forked one, such as a worker of a DataLoader, has its own."""
    with _starting:
        found = _processes.get(os.getpid())
        if found is None or found.popen.poll() is not None:
            _processes[os.getpid()] = found = _Process()
            atexit.register(found.end)
        return found


def serve_requests() -> None:
    """What the process does: answer until nobody asks."""
    connection = Connection(0)
    with suppress(EOFError):
        while True:
            allowed_gb, module, name, path, *args = json.loads(connection.recv_bytes())
            os.environ.pop(VARIABLE, None)
            os.environ |= {} if allowed_gb is None else {VARIABLE: allowed_gb}
            limit_resources(find_memory_limit_gb())
            error, arrays = None, Arrays()
            try:
                read = unwrap(getattr(import_module(module), name))  # or it would ask another process
                for key, array in read(Path(path), *args).items():
                    arrays[key] = np.ascontiguousarray(array.astype(str) if array.dtype.hasobject else array)
                check_memory(sum(array.nbytes for array in arrays.values()))
            except Exception as raised:
                error, arrays = _describe(raised, path), {}
            listed = [[key, array.dtype.str, array.shape] for key, array in arrays.items()]
            connection.send_bytes(json.dumps([error, listed]).encode())
            with open(connection.fileno(), "wb", closefd=False) as pipe:
                for array in arrays.values():
                    pipe.write(array.reshape(-1).view(np.uint8).data)
            del arrays
            if get_used_bytes() > LIBRARIES_GB * 1e9:  # or what is kept of one file would add to the next one's
                os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _describe(error: Exception, path: str) -> list[str]:
    """Name the type of an error, if it is one of `KNOWN_ERRORS`, and its message."""
    if isinstance(error, ModuleNotFoundError):  # which no reader has met with words of its own
        return ["ImportError", f"{path}: {error.name} is needed to read it: pip install {error.name}"]
    known = next((kind.__name__ for kind in type(error).__mro__ if kind.__name__ in KNOWN_ERRORS), "")
    return [known, str(error) if known else f"{type(error).__name__}: {error}"]
