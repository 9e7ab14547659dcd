"""Depth encodings."""

import builtins
import struct
import zlib
from inspect import unwrap

import numpy as np
import OpenEXR
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from torchcover.cameras import decode_carla, read_depth
from torchcover.cameras.isolated_images import read_exr_image
from torchcover.files import BadFileError


def encode_carla(depth_m, order):
    code = round(depth_m / 1000.0 * (2**24 - 1))
    channels = {"R": code % 256, "G": code // 256 % 256, "B": code // 65536, "A": 255}
    return [channels[name] for name in order]


@given(depth_m=st.floats(0.0, 999.9), order=st.sampled_from(["BGRA", "RGBA", "BGR", "RGB"]))
def test_carla_depth_is_decoded_within_its_resolution(depth_m, order):
    depth = decode_carla(np.array([[encode_carla(depth_m, order)]], dtype=np.uint8), order)
    assert depth.item() == pytest.approx(depth_m, abs=1000.0 / (2**24 - 1) + depth_m * 1e-7)


def test_only_the_largest_carla_code_is_infinite():
    depth = decode_carla(np.array([[[255, 255, 255], [254, 255, 255]]], dtype=np.uint8), "RGB")
    assert depth[0, 0] == torch.inf
    assert depth[0, 1] < 1000.0001


@pytest.mark.parametrize("order", ["RGB", "RGBA"])
def test_color_png_is_read_as_carla_depth(tmp_path, order):
    depth_m = np.array([[2.5, 7.0], [400.0, 1000.0]])
    pixels = np.array([[encode_carla(value, order) for value in row] for row in depth_m], dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "depth.png")
    expected = torch.tensor([[2.5, 7.0], [400.0, torch.inf]])
    torch.testing.assert_close(read_depth(tmp_path / "depth.png"), expected, rtol=0, atol=1e-4)


def test_gray_png_is_scaled(tmp_path):
    Image.fromarray(np.array([[0, 1500, 65535]], dtype=np.uint16)).save(tmp_path / "depth.png")
    depth = read_depth(tmp_path / "depth.png", meters_per_unit=0.001)
    assert depth.tolist() == [[0.0, 1.5, torch.inf]]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_npy_floats_are_meters(tmp_path, dtype):
    np.save(tmp_path / "depth.npy", np.array([[0.5, np.inf]], dtype=dtype))
    depth = read_depth(tmp_path / "depth.npy")
    assert depth.dtype == torch.float32
    assert depth.tolist() == [[0.5, torch.inf]]


def test_exr(tmp_path):
    values = np.array([[0.5, 2.0], [3.0, np.inf]], dtype=np.float32)
    OpenEXR.File({}, {"Z": values}).write(str(tmp_path / "depth.exr"))
    assert read_depth(tmp_path / "depth.exr").tolist() == values.tolist()
    OpenEXR.File({}, {"Z": values, "A": values}).write(str(tmp_path / "two.exr"))
    with pytest.raises(ValueError, match=r"one channel; got A, Z"):
        read_depth(tmp_path / "two.exr")


def test_exr_without_its_package(tmp_path, monkeypatch):
    plain = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "OpenEXR":
            raise ImportError(name)
        return plain(name, *args, **kwargs)

    (tmp_path / "depth.exr").write_bytes(b"v/1")
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(ImportError, match=r"torchcover\[exr\]"):
        unwrap(read_exr_image)(tmp_path / "depth.exr", 1)


def png_header(width, height, bits=8, colour=6):
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))


def test_images_beyond_file_size_or_memory_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "depth.png"
    path.write_bytes(png_header(30_000, 30_000))
    with pytest.raises(BadFileError, match=r"depth\.png: truncated: the header claims 30000x30000 pixels"):
        read_depth(path)
    path.write_bytes(png_header(30_000, 30_000) + bytes(4_000_000))
    with pytest.raises(BadFileError, match=r"depth\.png: reading it takes 28\.8 GB of memory"):
        read_depth(path)
    for name in ("d.png", "d.npy", "d.exr"):
        path = tmp_path / name
        if name == "d.exr":
            OpenEXR.File({}, {"Z": np.ones((100, 100), np.float32)}).write(str(path))
        else:
            save(path, np.ones((100, 100), np.uint16))
        scale = None if name == "d.exr" else 0.5
        assert read_depth(path, meters_per_unit=scale).shape == (100, 100)
        with monkeypatch.context() as context:
            context.setenv("TORCHCOVER_MAX_FILE_GB", "0.0003")
            with pytest.raises(BadFileError, match=rf"{name}: reading it takes 0\.00032 GB"):
                read_depth(path, meters_per_unit=scale)


def test_truncated_images_are_refused(tmp_path):
    save(tmp_path / "d.png", np.random.default_rng(0).integers(0, 255, (40, 40, 3), dtype=np.uint8))
    OpenEXR.File({}, {"Z": np.ones((40, 40), np.float32)}).write(str(tmp_path / "d.exr"))
    for name in ("d.png", "d.exr"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[:-40])
        with pytest.raises(BadFileError, match=rf"{name}: (not readable as a depth image|truncated or damaged)"):
            read_depth(path)


def save(path, array):
    np.save(path, array) if path.suffix == ".npy" else Image.fromarray(array).save(path)


@pytest.mark.parametrize(
    ("name", "array", "scale", "message"),
    [
        ("d.png", np.zeros((2, 2), np.uint8), None, "8 bits, color type 0"),
        ("d.png", np.zeros((2, 2), np.uint16), None, "meters_per_unit > 0 .*got None"),
        ("d.png", np.zeros((2, 2), np.uint16), -1.0, "got -1.0"),
        ("d.png", np.zeros((2, 2, 3), np.uint8), 0.001, "takes no meters_per_unit"),
        ("d.npy", np.zeros((2, 2)), 0.001, "takes no meters_per_unit"),
        ("d.npy", np.zeros((2, 2), np.int32), None, "int32 depth needs"),
        ("d.npy", np.zeros((2, 2), bool), 1.0, "integers or floats; got bool"),
        ("d.npy", np.zeros((2, 2, 2)), None, r"shape \(H, W\); got \(2, 2, 2\)"),
        ("d.jpg", np.zeros((2, 2, 3), np.uint8), None, r"got '.jpg'"),
    ],
)
def test_invalid_depth_files_are_refused(tmp_path, name, array, scale, message):
    save(tmp_path / name, array)
    with pytest.raises(BadFileError, match=rf"{name}: .*{message}"):
        read_depth(tmp_path / name, meters_per_unit=scale)


@pytest.mark.parametrize(
    ("image", "order", "message"),
    [
        (np.zeros((2, 2, 3), np.uint8), "GBR", "'GBR' is unknown; allowed: BGRA"),
        (np.zeros((2, 2, 3), np.uint8), "BGRA", r"\(H, W, 4\).*got shape \(2, 2, 3\)"),
        (np.zeros((2, 2, 3), np.float32), "RGB", "dtype float32"),
    ],
)
def test_invalid_carla_images_are_refused(image, order, message):
    with pytest.raises(ValueError, match=message):
        decode_carla(image, order)
