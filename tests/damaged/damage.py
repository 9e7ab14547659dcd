"""Methods to damage a file."""

import io
import re
import struct
import zipfile
import zlib

import numpy as np

from tests.damaged.good_files import archive

NUMBERS = (b"0", b"-1", b"1e999", b"nan", b"2.5", b"7", b"1000000000", b"9" * 18, b"9" * 30, b"9" * 5000, b"1e-320")
WORDS = (
    b"\n", b"\r", b"\0" * 8, b" ", b",", b";", b":", b"- ", b"[", b"]", b"{", b"}", b"(", b"'", b'"', b"#", b"*a",
    b"&a ", b"!!python/object:os.system ", b"\xff\xfe", b"\xef\xbb\xbf", b"1,5 2,5 3,5\n", b"true", b"null", b"e", b".",
    b"x y z\n", b"element vertex 9\n", b"COUNT 1 1 1000000000\n", b"property list uchar int i\n",
    b"DATA binary_compressed\n",
)  # fmt: skip
BITS = tuple(
    struct.pack(kind, value)
    for kind, value in (
        ("<I", 0), ("<I", 2**31 - 1), ("<I", 2**32 - 1), (">I", 2**31 - 1), (">I", 30_000), ("<I", 10**8),
        ("<q", 2**62), ("<q", -1), ("<f", np.nan), ("<f", np.inf), ("<f", 1e38), ("<f", 1e-42),
        ("<d", 1e300), ("<H", 65535),
    )
)  # fmt: skip


def damaged(data, others, random):
    """Bytes with one to three things wrong with them.

    Args:
        data: A good file.
        others: Other good files, of which parts may get in.
        random: A `random.Random`.
    """
    inside = {b"PK\x03\x04": _inside_archive, b"\x89PNG": _inside_png}.get(data[:4])
    if inside is not None and random.random() < 0.6:
        return inside(data, others, random)
    return _damaged(data, others, random)


def _damaged(data, others, random):
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        data = random.choice(WAYS)(data, random) if random.random() < 0.95 else _spliced(data, others, random)
    return data


def _place(data, random):
    """Choose a position, preferably in the header."""
    return random.randrange(min(len(data), random.choice((16, 200, 10**6))) + 1)


def _cut(data, random):
    return data[: _place(data, random)]


def _without(data, random):
    at = _place(data, random)
    return data[:at] + data[at + random.choice((1, 2, 4, 16, 100)) :]


def _flipped(data, random):
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 2, 8))):
        if changed:
            changed[_place(data, random) % len(changed)] ^= 1 << random.randrange(8)
    return bytes(changed)


def _word(data, random):
    at = _place(data, random)
    return data[:at] + random.choice(WORDS) + data[at:]


def _bits(data, random):
    at, bits = _place(data, random), random.choice(BITS)
    return data[:at] + bits + data[at + len(bits) :]


def _number(data, random):
    result = list(re.finditer(rb"-?\d+(\.\d+)?", data[:4000]))
    if not result:
        return _bits(data, random)
    one = random.choice(result)
    return data[: one.start()] + random.choice(NUMBERS) + data[one.end() :]


def _lines(data, random):
    lines = data.split(b"\n")
    first, second = random.randrange(min(len(lines), 12)), random.randrange(len(lines))
    what = random.randrange(3)
    if what == 0:
        lines[first], lines[second] = lines[second], lines[first]
    elif what == 1:
        lines.insert(second, lines[first])
    else:
        del lines[first]
    return b"\n".join(lines)


def _field(data, random):
    """Damage a row by an additional or missing column, or another name."""
    words = re.split(rb"([ ,]+)", data[:4000])
    at = random.randrange(len(words))
    words[at : at + 1] = random.choice(([], [words[at]] * 3, [random.choice(words)]))
    return b"".join(words) + data[4000:]


def _zeros(data, random):
    at = _place(data, random)
    length = random.choice((4, 16, 200, len(data)))
    return data[:at] + bytes(len(data[at : at + length])) + data[at + length :]


def _longer(data, random):
    at = _place(data, random)
    return data + data[at:] * random.choice((1, 3, 20))


WAYS = (_cut, _without, _flipped, _word, _bits, _bits, _number, _number, _lines, _field, _zeros, _longer)


def _spliced(data, others, random):
    other = random.choice(others)
    return random.choice((other, data[: _place(data, random)] + other[_place(other, random) :]))


def _inside_archive(data, others, random):
    """Damage the files of an archive and keep its checksums valid."""
    with zipfile.ZipFile(io.BytesIO(data)) as file:
        members = {name: file.read(name) for name in file.namelist()}
    name = random.choice(list(members))
    members[name] = _damaged(members[name], others, random)
    return archive(members, random.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_BZIP2)))


def _inside_png(data, others, random):
    """Damage the content of an image and keep its checksums valid."""
    chunks, at = [], 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + length]))
        at += 12 + length
    chosen = random.randrange(len(chunks))
    kind, content = chunks[chosen]
    plain = zlib.decompress(content) if kind == b"IDAT" and random.random() < 0.5 else None
    content = _damaged(content, others, random) if plain is None else zlib.compress(_damaged(plain, others, random))
    chunks[chosen] = (kind, content)
    framed = (
        struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body)) for name, body in chunks
    )
    return data[:8] + b"".join(framed)
