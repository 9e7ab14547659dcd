"""Libraries that are not Python read in a process of their own: a damaged file ends that one, and not the run.

The process is a plain one that imports no torch, reads file after file for as long as its parent lives, and has limits
of memory, time and open files for each. What goes through the pipes is JSON and the bytes of arrays.
"""

import atexit
import json
import os
import select
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import wraps
from importlib import import_module
from inspect import unwrap
from pathlib import Path
from typing import IO, Any, Concatenate, ParamSpec

import numpy as np
from numpy.typing import NDArray

from torchcover.files.bad_file import LIBRARIES_GB, VARIABLE, BadFileError, check_memory, most_gb, reads
from torchcover.files.processes import end_with_parent, is_stopped, limit, reporting_stopped, used_bytes

Arguments = ParamSpec("Arguments")
Arrays = dict[str, NDArray[Any]]
Reader = Callable[Concatenate[Path, Arguments], Arrays]

# A file may take so long, and a second more for each megabyte.
MOST_S = 60.0
BYTES_PER_S = 1e6
KNOWN_ERRORS = {kind.__name__: kind for kind in (BadFileError, ValueError, MemoryError, ImportError, FileNotFoundError)}
# As much as a scan has: or both wait for each other, again and again.
PIPE_BYTES = 1 << 20
# The same modules as here, whatever folder this one was started in.
PROGRAM = "import sys; sys.path[:] = {path!r}; from torchcover.files.isolated import serve; serve()"


def apart(read: Reader[Arguments]) -> Reader[Arguments]:
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
        self._popen = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.format(path=sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,  # where OpenEXR says what is wrong
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            preexec_fn=end_with_parent(),  # noqa: PLW1509  (it calls prctl only)
            pipesize=PIPE_BYTES,
        )

    def is_alive(self) -> bool:
        return self._popen.poll() is None

    def ask(self, request: list[Any], limit_s: float) -> Arrays:
        requests, answers = self._popen.stdin, self._popen.stdout
        assert requests is not None
        assert answers is not None
        with self.lock, reporting_stopped([self._popen.pid], "the process that reads files"):
            try:
                _send(requests, request)
                answer, arrays = _received(answers, limit_s)
            except (BrokenPipeError, EOFError, TimeoutError) as error:
                late, stopped = isinstance(error, TimeoutError), is_stopped(self._popen.pid)
                self.end()
                if stopped:
                    raise ValueError(
                        f"the process that reads it was stopped for {limit_s:.0f} s; read it again"
                    ) from error
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
        self._popen.kill()
        for pipe in (self._popen.stdin, self._popen.stdout):
            with suppress(BrokenPipeError):
                assert pipe is not None
                pipe.close()
        self._popen.wait()


_processes: dict[int, _Process] = {}
_starting = threading.Lock()


def _own_process() -> _Process:
    """That of this process: a forked one, such as a worker of a DataLoader, has its own."""
    with _starting:
        found = _processes.get(os.getpid())
        if found is None or not found.is_alive():
            _processes[os.getpid()] = found = _Process()
            atexit.register(found.end)
        return found


def serve() -> None:
    """What the process does: answer until nobody asks."""
    requests, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a library that prints must not answer
    with suppress(EOFError):
        while True:
            allowed_gb, module, name, path, *args = _received_json(requests)
            os.environ.pop(VARIABLE, None)
            os.environ |= {} if allowed_gb is None else {VARIABLE: allowed_gb}
            limit(most_gb())
            try:
                read = unwrap(getattr(import_module(module), name))  # or it would ask another process
                arrays = {key: _plain(array) for key, array in read(Path(path), *args).items()}
                check_memory(sum(array.nbytes for array in arrays.values()))
            except Exception as error:
                known = next((kind.__name__ for kind in type(error).__mro__ if kind.__name__ in KNOWN_ERRORS), "")
                told = str(error) if known else f"{type(error).__name__}: {error}"
                if isinstance(error, ModuleNotFoundError):  # which no reader has met with words of its own
                    told = f"{path}: {error.name} is needed to read it: pip install {error.name}"
                _send(answers, [[known, told], []])
            else:
                _send(answers, [None, [[key, array.dtype.str, array.shape] for key, array in arrays.items()]])
                for array in arrays.values():
                    answers.write(array.reshape(-1).view(np.uint8).data)
                answers.flush()
                del arrays
            if used_bytes() > LIBRARIES_GB * 1e9:  # or what is kept of one file would add to the next one's
                os.dup2(answers.fileno(), 1)
                os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _plain(array: NDArray[Any]) -> NDArray[Any]:
    """Of numbers or text, in one piece."""
    return np.ascontiguousarray(array.astype(str) if array.dtype.hasobject else array)


def _send(pipe: IO[bytes], message: object) -> None:
    data = json.dumps(message).encode()
    pipe.write(len(data).to_bytes(8, "little") + data)
    pipe.flush()


def _received(pipe: IO[bytes], limit_s: float) -> tuple[list[str] | None, Arrays]:
    if not select.select([pipe], [], [], limit_s)[0]:
        raise TimeoutError
    error, listed = _received_json(pipe)
    arrays = {}
    for name, dtype, shape in listed:
        arrays[name] = np.empty(shape, dtype)
        _fill(pipe, arrays[name].reshape(-1).view(np.uint8).data)
    return error, arrays


def _received_json(pipe: IO[bytes]) -> Any:  # noqa: ANN401
    return json.loads(_whole(pipe, int.from_bytes(_whole(pipe, 8), "little")))


def _whole(pipe: IO[bytes], size: int) -> bytearray:
    data = bytearray(size)
    _fill(pipe, memoryview(data))
    return data


def _fill(pipe: IO[bytes], room: memoryview) -> None:
    while room:
        count = pipe.readinto(room)  # type: ignore[attr-defined]
        if not count:
            raise EOFError
        room = room[count:]


@reads("a feather table")
@apart
def read_feather(path: Path, names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read columns of a feather table.

    Returns name -> numbers, or text. BadFileError: no such table, a column that is missing or has holes, or no rows.
    ImportError: pyarrow is not installed.
    """
    try:
        from pyarrow import feather
    except ImportError as error:
        raise ImportError(f"{path}: a feather table needs pyarrow: pip install 'torchcover[av2]'") from error
    check_memory(4 * path.stat().st_size)
    table = feather.read_table(path)
    table.validate(full=True)  # pyarrow believes the lengths and places in the file, and reads there
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise ValueError(f"the columns {', '.join(names)} are needed; {', '.join(missing)} are missing")
    if table.num_rows == 0:
        raise ValueError("a table without rows")
    holes = [name for name in names if table.column(name).null_count]
    if holes:
        raise ValueError(f"the columns {', '.join(holes)} have holes")
    return {name: table.column(name).to_numpy() for name in names}


@apart
def exr_image(path: Path, bytes_per_pixel: int) -> dict[str, NDArray[Any]]:
    """(H, W) `pixels` of an EXR image with one channel, each of which may take so much memory."""
    try:
        import OpenEXR  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise ImportError(f"{path}: reading EXR needs the package OpenEXR: pip install 'torchcover[exr]'") from error
    # The header alone first: with the pixels, memory is reserved for as many as it claims.
    with OpenEXR.File(str(path), header_only=True) as file:
        headers = [file.header(part) for part in range(len(file.parts))]
        channels = [channel.name for header in headers for channel in header["channels"]]
        if len(channels) != 1:
            raise ValueError(f"a depth EXR has one channel; got {', '.join(channels)[:80] or 'none'}")
        low, high = headers[0]["dataWindow"]
        width, height = (int(last) - int(first) + 1 for first, last in zip(low, high, strict=True))
    check_memory(width * height * bytes_per_pixel)
    with OpenEXR.File(str(path)) as file:
        # It prints what is wrong with the pixels, and leaves them out.
        values = [np.array(channel.pixels) for part in file.parts for channel in part.channels.values()]
    if len(values) != 1 or values[0].shape != (height, width):
        raise ValueError(f"truncated or damaged: {width}x{height} pixels are claimed and cannot be read")
    return {"pixels": values[0]}


@apart
def laz_points(path: Path, points: int) -> dict[str, NDArray[Any]]:
    """(N, 3) int32 `xyz` as they are written in a LAZ file, of so many points."""
    try:
        import laspy
        import lazrs  # noqa: F401  (which laspy decompresses with)
    except ImportError as error:
        raise ImportError(f"{path}: LAZ needs laspy: pip install 'torchcover[las]'") from error
    with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs, read_evlrs=False) as reader:
        found = reader.read_points(points)
    if len(found) != points:
        raise ValueError(f"the header claims {points} points; {len(found)} are there")
    return {"xyz": np.column_stack([found.X, found.Y, found.Z])}


@apart
def png_image(path: Path) -> dict[str, NDArray[Any]]:
    """Read the `pixels` of a PNG image, whose header was checked before."""
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as image:
            return {"pixels": np.asarray(image)}
    except (OSError, SyntaxError) as error:  # the latter is Pillow's for chunks that do not hold together
        raise ValueError(f"truncated or damaged: {error}") from error


@apart
def lzf_block(path: Path, start: int, compressed_bytes: int, plain_bytes: int) -> dict[str, NDArray[Any]]:
    """Decompress the block of a file that begins at the byte `start`, into `plain` (plain_bytes,) uint8."""
    import lzf

    with path.open("rb") as file:
        file.seek(start)
        plain = lzf.decompress(file.read(compressed_bytes), plain_bytes)
    if plain is None or len(plain) != plain_bytes:
        raise ValueError(f"the compressed block does not grow to the {plain_bytes} bytes that it claims")
    return {"plain": np.frombuffer(plain, np.uint8)}
