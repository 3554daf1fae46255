"""Images as files: all pixels are there, and no more than are read, or they are refused."""

import io
import struct
import time
import zlib

import fuzzing
import numpy as np
import pytest
from PIL import Image

from pytest_cpas.reading import images
from pytest_cpas.reading.images import read_depth, read_ids, read_rgb
from pytest_cpas.reading.png import MOST_CHUNKS, check_rows, png_parts
from pytest_cpas.types import Camera, DataError

CAMERA = fuzzing.CAMERA
READERS = {"RGB": read_rgb, "I;16": read_depth, "L": read_ids}


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width, height, depth, colour, pixels, interlaced=0, before=b""):
    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlaced)
    parts = chunk(b"IHDR", header) + before + chunk(b"IDAT", zlib.compress(pixels))
    return b"\x89PNG\r\n\x1a\n" + parts + chunk(b"IEND", b"")


@pytest.mark.parametrize("mode", READERS)
def test_rows_that_are_missing_are_not_zeros(mode, tmp_path):
    """The stream of pixels ends early, and says so itself: nothing else is wrong with the file."""
    colour, depth, size = {"RGB": (2, 8, 3), "I;16": (0, 16, 2), "L": (0, 8, 1)}[mode]
    row = b"\0" + b"\7" * (CAMERA.width * size)
    path = tmp_path / "x.png"
    whole = CAMERA.height * len(row)
    for length in (whole, whole - 1, whole - len(row), len(row), 0):
        pixels = (row * CAMERA.height)[:length]
        path.write_bytes(png(CAMERA.width, CAMERA.height, depth, colour, pixels))
        if length == whole:
            assert READERS[mode](path, CAMERA).min() > 0
            continue
        with pytest.raises(
            DataError, match=rf"x\.png: not a readable image: truncated, {length} of {whole} bytes"
        ):
            READERS[mode](path, CAMERA)


@pytest.mark.parametrize("colour", [0, 2, 3, 4, 6])
@pytest.mark.parametrize("width", [1, 3, 9])
def test_size_of_the_pixels_of_a_sound_png(colour, width):
    """Of every size of value and, with passes whose rows differ, interlaced."""
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[colour]
    for depth in (1, 2, 4, 8, 16) if colour == 0 else (8,):
        row = 1 + -(-width * channels * depth // 8)
        image = png_parts("x", png(width, 5, depth, colour, bytes(row * 5)))
        assert image.size == 5 * row
        check_rows("x", image)
        passes = png_parts("x", png(width, 5, depth, colour, b"", interlaced=1))
        assert passes.size == interlaced_size(width, 5, channels * depth)


def interlaced_size(width, height, bits):
    """Pixel by pixel, by the pass that the standard's table of 8 x 8 pixels gives each."""
    table = ("16462646", "77777777", "56565656", "77777777", "36463646", "77777777", "56565656")
    table = (*table, "77777777")
    rows = {}
    for y in range(height):
        for x in range(width):
            key = table[y % 8][x % 8], y
            rows[key] = rows.get(key, 0) + 1
    return sum(1 + -(-count * bits // 8) for count in rows.values())


def test_images_that_are_cut_off_or_too_large(tmp_path):
    path = tmp_path / "x.png"
    content = fuzzing.images("RGB")()[0]
    path.write_bytes(content)
    whole = read_rgb(path, CAMERA)
    for length in range(0, len(content), 11):
        path.write_bytes(content[:length])
        try:
            seen = read_rgb(path, CAMERA)
        except DataError as error:
            refused = length
            assert "x.png: " in str(error)  # noqa: PT017
        else:
            np.testing.assert_array_equal(seen, whole)
    assert refused > len(content) - 40  # behind its last pixel nothing matters
    for width, height in ((13_000, 13_000), (2**20, 2**20)):
        path.write_bytes(png(width, height, 8, 2, b""))
        camera = Camera(width, height, 1, 1, 0, 0)
        with pytest.raises(
            DataError, match=rf"x\.png: {width} x {height} pixels, at most 33554432"
        ):
            read_rgb(path, camera)


def test_chunks_without_end(tmp_path):
    path = tmp_path / "x.png"
    row = b"\0" + bytes(3 * CAMERA.width)
    more = chunk(b"tEXt", b"a\0b")
    path.write_bytes(png(CAMERA.width, CAMERA.height, 8, 2, row * CAMERA.height, before=more * 50))
    read_rgb(path, CAMERA)
    path.write_bytes(png(CAMERA.width, CAMERA.height, 8, 2, row, before=more * MOST_CHUNKS))
    start = time.process_time()
    with pytest.raises(
        DataError, match=r"x\.png: not a readable image: it has more than 65536 chunks"
    ):
        read_rgb(path, CAMERA)
    assert time.process_time() - start < 1


@pytest.mark.parametrize("read", [read_depth, read_ids])
def test_what_jpeg_would_change_is_read_of_png_alone(read, tmp_path):
    path = tmp_path / "x.png"
    Image.new("L", (CAMERA.width, CAMERA.height), 200).save(path, "JPEG")
    with pytest.raises(DataError, match=r"x\.png: not a readable image: it begins with b..xff.*P"):
        read(path, CAMERA)
    Image.new("RGB", (CAMERA.width, CAMERA.height)).save(path, "JPEG")
    read_rgb(path, CAMERA)


def exr(path, channels):
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    openexr.File(header, channels).write(str(path))


def test_exr_that_is_too_large(tmp_path, monkeypatch):
    path, camera = tmp_path / "x.exr", Camera(64, 64, 1, 1, 0, 0)
    depth = np.ones((64, 64), np.float32)
    exr(path, {"D": depth, "Z": depth})
    assert read_depth(path, camera).min() == 1
    monkeypatch.setattr(images, "_LARGEST_CHANNELS", 2 * depth.nbytes - 1)
    with pytest.raises(DataError, match=r"x\.exr: its 2 channels are up to 32768 bytes, at most"):
        read_depth(path, camera)
    monkeypatch.setattr(images, "MOST_PIXELS", 64 * 64 - 1)
    with pytest.raises(DataError, match=r"x\.exr: 64 x 64 pixels, at most 4095"):
        read_depth(path, camera)


def test_exr_that_is_cut_off(tmp_path, capfd):
    path, camera = tmp_path / "x.exr", Camera(8, 8, 1, 1, 0, 0)
    exr(path, {"D": np.random.default_rng(0).random((8, 8)).astype(np.float32)})
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(DataError, match=r"x\.exr: "):
            read_depth(path, camera)


def test_interlaced_images_are_read(tmp_path):
    image = png(8, 8, 8, 0, bytes([1]) * interlaced_size(8, 8, 8), interlaced=1)
    path = tmp_path / "x.png"
    path.write_bytes(image)
    whole = np.asarray(Image.open(io.BytesIO(image)))
    np.testing.assert_array_equal(read_ids(path, Camera(8, 8, 1, 1, 0, 0)), whole)
