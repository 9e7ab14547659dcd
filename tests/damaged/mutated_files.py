"""Read damaged files with every reader, and measure outcome, time and memory."""

import contextlib
import os
import random
import resource
import signal
import struct
import tempfile
import time
import warnings
import zlib
from pathlib import Path

from tests.damaged.damage import damaged
from tests.damaged.good_files import Kind, archive, ply
from torchcover.files import BadFileError

# A reader that never ends.
STOP_SECONDS = 30


class Endless(BaseException):
    """Timeout of a reader, not caught by handlers of errors."""


def mutated(every, number, seed=0):
    """Return the bytes of the mutated file of a number and seed, always the same."""
    kind, draw = every[number % len(every)], random.Random(f"mutated file {number}" + f" of {seed}" * (seed > 0))
    return damaged(kind.data, [other.data for other in every], draw)


def attempt(kind, data, folder, messages=None):
    """Read a file.

    Returns:
        "read", "bad" (a `BadFileError` that names the file), "unnamed" (one that does not), "slow" (stopped) or
        "foreign: ..."; seconds; MB by which the process has grown beyond its largest size so far.
    """
    for name, beside in ((kind.name, data), *kind.beside):
        folder.joinpath(name).write_bytes(beside)
    return _attempt(kind, folder / kind.name, messages)


def _attempt(kind, path, messages=None):
    before, start = largest_mb(), time.perf_counter()
    signal.signal(signal.SIGALRM, _stop)
    signal.alarm(STOP_SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "yaw_rad goes beyond a full turn")  # which it then does
            warnings.filterwarnings("ignore", ".*VIEWPOINT .* is not applied")  # of a readable file
            kind.read(path)
        outcome = "read"
    except BadFileError as error:
        message = str(error)
        outcome = "bad" if str(path.parent) in message and "\n" not in message else "unnamed"
        if "Warning:" in message:
            outcome = f"foreign: {message}"
        if messages is not None:
            reason = "".join("0" if sign.isdigit() else sign for sign in message.removeprefix(f"{path}: "))
            messages.setdefault((kind.name, reason[:30]), f"{kind.name}: {message.removeprefix(f'{path}: ')[:220]}")
    except Endless:
        outcome = "slow"
    except Exception as error:
        outcome = f"foreign: {type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
    return outcome, time.perf_counter() - start, largest_mb() - before


def attempt_pipe(kind, folder):
    with tempfile.TemporaryDirectory(dir=folder) as own:
        for name, beside in kind.beside:
            Path(own, name).write_bytes(beside)
        path = Path(own, kind.name)
        os.mkfifo(path)
        return _attempt(kind, path)


def bombs(every):
    """Create small files that claim or decompress to gigabytes."""
    clouds = {kind.name: kind for kind in every}

    def of(name, data):
        return Kind(name, data, clouds[name].read, clouds[name].beside)

    header = clouds["binary.pcd"].data.partition(b"DATA")[0].replace(b"COUNT 1 1 1 1", b"COUNT 1 1 1 1000000000")
    none = header.replace(b"WIDTH 20", b"WIDTH 0").replace(b"POINTS 40", b"POINTS 0")
    gigabytes = _deflated_zeros(5700)
    npy = clouds["c64.npy"].data[:128].replace(b"(40, 3), }            ", b"(237500000, 3), }     ")
    image = clouds["rgba.png"].data
    yield "PCD, COUNT 1000000000, no points", of("binary.pcd", none + b"DATA binary\n")
    yield "PCD, COUNT 1000000000, 40 points", of("binary.pcd", header + b"DATA binary\n" + bytes(640))
    yield "PCD, COUNT 1000000000, ascii", of("ascii.pcd", header + b"DATA ascii\n" + b"1 2 3 4\n" * 40)
    yield "npz, 5.7 GB of zeros", of("deflated.npz", _npz_of(npy, gigabytes, 5700 << 20))
    yield "npz, that claims 1 GB", of("stored.npz", _claiming(clouds["stored.npz"].data, 10**9))
    yield "coverage, 5.7 GB of zeros", of("coverage.npz", _npz_of(npy, gigabytes, 5700 << 20))
    yield "PNG, 30000 x 30000, all there", of("rgba.png", _png_of(image, 30_000, _deflated_zeros(3434)))
    yield "PNG, 30000 x 30000, claimed", of("rgba.png", _png_of(image, 30_000, zlib.compress(bytes(99))))
    yield (
        "PLY, 10^15 points",
        of("ascii.ply", ply("ascii", b"1 2 3 4\n" * 40).replace(b"vertex 40", b"vertex 1" + b"0" * 15)),
    )
    laughs = b"a0: &a0 [1, 1]\n" + b"".join(
        b"a%d: &a%d [%s]\n" % (n, n, b", ".join([b"*a%d" % (n - 1)] * 9)) for n in range(1, 12)
    )
    for key in (b"distortion_model", b"distortion_coefficients", b"camera_name", b"image_width", b"camera_matrix"):
        lines = [line for line in clouds["ros.yaml"].data.split(b"\n") if not line.startswith(key)]
        yield f"YAML, laughs as {key.decode()}", of("ros.yaml", laughs + b"\n".join(lines) + key + b": *a11\n")
    yield (
        "YAML, laughs as a pose",
        of("frames.yaml", b"rigs: &r {roof: {vehicle_T_sensor: &a [[1]]}}\nsensor: {vehicle_T_sensor: [*a]}\n"),
    )
    yield "YAML, 20 MB", of("ros.yaml", clouds["ros.yaml"].data + b"# " + b"x" * 20_000_000)
    yield "JSON, 100000 deep", of("sensor.json", b"[" * 100_000)


def _deflated_zeros(megabytes):
    """Create a raw deflate stream of zeros from copies of one block."""

    def part(mode):
        packer = zlib.compressobj(9, zlib.DEFLATED, -15)
        return packer.compress(bytes(1 << 20)) + packer.flush(mode)

    return part(zlib.Z_FULL_FLUSH) * (megabytes - 1) + part(zlib.Z_FINISH)


def _npz_of(npy, deflated, size):
    """An archive of one array: a header and zeros, whose checksum nobody gets to see."""
    stored = struct.pack("<BHH", 0, len(npy), len(npy) ^ 0xFFFF) + npy + deflated
    good = bytearray(archive({"points.npy": b""}))
    directory = good.index(b"PK\x01\x02")
    for at, field in ((18, 0), (20, directory)):
        struct.pack_into("<II", good, at + field, len(stored), size % 2**32)
    body = bytes(good[:40]) + stored
    return body + _zip64(bytes(good[directory:]), size, len(stored), len(body))


def _zip64(end, size, packed, start):
    entry, tail = bytearray(end[: 46 + 10]), bytearray(end[end.index(b"PK\x05\x06") :])
    extra = struct.pack("<HHQ", 1, 8, size)
    struct.pack_into("<II", entry, 20, packed, 0xFFFFFFFF)
    struct.pack_into("<H", entry, 30, len(extra))
    struct.pack_into("<II", tail, 12, len(entry) + len(extra), start)
    return bytes(entry) + extra + bytes(tail)


def _claiming(data, size):
    changed = bytearray(data)
    struct.pack_into("<I", changed, changed.index(b"PK\x01\x02") + 24, size)
    return bytes(changed)


def _png_of(image, side, deflated):
    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0)
    return image[:8] + chunk(b"IHDR", header) + chunk(b"IDAT", b"\x78\x9c" + deflated) + chunk(b"IEND", b"")


def largest_mb():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _stop(*_):
    raise Endless


@contextlib.contextmanager
def silence_libraries():
    """Suppress messages of OpenEXR."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
