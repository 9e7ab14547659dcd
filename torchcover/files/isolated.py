"""Isolated readers: native libraries read in a child process, which a damaged file may crash without ending the run.

The process does not import torch, reads one file after another until its parent ends, and has limits of memory, time
and open files for each. Messages are JSON and the bytes of arrays.
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
    start_program,
)

Arguments = ParamSpec("Arguments")
Arrays = dict[str, NDArray[Any]]
Reader = Callable[Concatenate[Path, Arguments], Arrays]

BASE_TIMEOUT_S = 60.0  # time limit for a file, plus a second for each megabyte
ERROR_TYPES = {kind.__name__: kind for kind in (BadFileError, ValueError, MemoryError, ImportError, FileNotFoundError)}
# Imports the same modules as this process, whatever its working directory.
PROGRAM = "import sys; sys.path[:] = {path!r}; from torchcover.files.isolated import serve_requests; serve_requests()"


def run_isolated(read: Reader[Arguments]) -> Reader[Arguments]:
    """Run a reader in the isolated process.

    Args:
        read: Function of a module that does not import torch. It takes the path and arguments that JSON can represent,
            and returns arrays by name. A `ValueError`, `MemoryError`, `ImportError` or `FileNotFoundError` is raised
            in this process, any other error as a `ValueError` with its name.

    Returns:
        Function with the same signature. It also raises a ValueError if the process crashes, or takes longer than 60 s
        plus a second per megabyte.
    """

    @wraps(read)
    def send_request(path: Path, *args: Arguments.args, **kwargs: Arguments.kwargs) -> Arrays:
        assert not kwargs
        files = path.iterdir() if path.is_dir() else [path]
        timeout_s = BASE_TIMEOUT_S + sum(file.stat().st_size for file in files) / 1e6
        request = [os.environ.get(VARIABLE), read.__module__, read.__name__, str(path.absolute()), *args]
        return _get_process().send(request, timeout_s)

    return send_request  # type: ignore[return-value]  # the type has the path as a positional parameter


class _ReaderProcess:
    """Isolated process that reads files."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._connection, child_connection = Pipe()
        with child_connection:
            self.popen = start_program(
                [sys.executable, "-c", PROGRAM.format(path=sys.path)],
                "the process that reads files",
                stdin=child_connection.fileno(),
                stdout=subprocess.DEVNULL,  # output of libraries must not mix with answers
                stderr=subprocess.DEVNULL,  # OpenEXR prints its errors
                env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
                preexec_fn=end_with_parent(),
            )

    def send(self, request: list[Any], timeout_s: float) -> Arrays:
        """Send a request and wait for the arrays, or raise the error of the reader."""
        with self.lock, report_stopped_processes([self.popen.pid], "the process that reads files"):
            try:
                self._connection.send_bytes(json.dumps(request).encode())
                error_answer, arrays = _receive(self._connection, timeout_s)
            except (ConnectionError, EOFError, TimeoutError) as error:
                was_stopped = is_stopped(self.popen.pid)
                self.kill()
                if was_stopped:
                    reason = f"the process that reads it was stopped for {timeout_s:.0f} s; read it again"
                    raise ValueError(reason) from error
                reason = "the library that reads it crashed"
                if isinstance(error, TimeoutError):
                    reason = f"it took more than {timeout_s:.0f} s"
                raise ValueError(f"{reason}; the file is damaged, or not what its name says") from error
            except BaseException:  # such as Ctrl-C: the next request must not receive this answer
                self.kill()
                raise
        if error_answer is not None:
            name, message = error_answer
            raise ERROR_TYPES[name](message) if name in ERROR_TYPES else ValueError(message)
        return arrays

    def kill(self) -> None:
        """Kill the process and wait for its end."""
        self.popen.kill()
        self._connection.close()
        self.popen.wait()


def _receive(connection: Connection, timeout_s: float) -> tuple[list[str] | None, Arrays]:
    """Receive an error description and the arrays of an answer."""
    if not connection.poll(timeout_s):
        raise TimeoutError
    error, headers = json.loads(connection.recv_bytes())
    arrays = {name: np.empty(shape, dtype) for name, dtype, shape in headers}
    with open(connection.fileno(), "rb", closefd=False) as pipe:
        for array in arrays.values():
            if pipe.readinto(array.reshape(-1).view(np.uint8).data) < array.nbytes:
                raise EOFError
    return error, arrays


_processes: dict[int, _ReaderProcess] = {}  # by id of the parent process
_process_lock = threading.Lock()


def _get_process() -> _ReaderProcess:
    """Return the reader of this process; a forked process, such as a worker of a DataLoader, has its own."""
    with _process_lock:
        process = _processes.get(os.getpid())
        if process is None or process.popen.poll() is not None:
            _processes[os.getpid()] = process = _ReaderProcess()
            atexit.register(process.kill)
        return process


def serve_requests() -> None:
    """Answer requests on stdin until the parent closes the connection; the main loop of the isolated process."""
    connection = Connection(0)
    with suppress(EOFError):
        while True:
            limit_gb, module, name, path, *args = json.loads(connection.recv_bytes())
            os.environ.pop(VARIABLE, None)
            if limit_gb is not None:
                os.environ[VARIABLE] = limit_gb
            limit_resources(find_memory_limit_gb())
            error_answer, arrays = None, Arrays()
            try:
                read = unwrap(getattr(import_module(module), name))  # the wrapper would start another process
                for key, array in read(Path(path), *args).items():
                    arrays[key] = np.ascontiguousarray(array.astype(str) if array.dtype.hasobject else array)
                check_memory(sum(array.nbytes for array in arrays.values()))
            except Exception as error:
                error_answer, arrays = _describe_error(error, path), {}
            headers = [[key, array.dtype.str, array.shape] for key, array in arrays.items()]
            connection.send_bytes(json.dumps([error_answer, headers]).encode())
            with open(connection.fileno(), "wb", closefd=False) as pipe:
                for array in arrays.values():
                    pipe.write(array.reshape(-1).view(np.uint8).data)
            del arrays
            if (
                get_used_bytes() > LIBRARIES_GB * 1e9
            ):  # memory that libraries keep would reduce the limit of later files
                os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _describe_error(error: Exception, path: str) -> list[str]:
    """Return the name of an error if it is one of `ERROR_TYPES`, else "", and its message."""
    if isinstance(error, ModuleNotFoundError):
        return ["ImportError", f"{path}: {error.name} is needed to read it: pip install {error.name}"]
    for kind in type(error).__mro__:
        if kind.__name__ in ERROR_TYPES:
            return [kind.__name__, str(error)]
    return ["", f"{type(error).__name__}: {error}"]
