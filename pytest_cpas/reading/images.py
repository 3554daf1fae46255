"""Reading images; every damage ends in a :class:`DataError` that names the file."""

from __future__ import annotations

import io
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pytest_cpas.reading.files import read_bytes, regular
from pytest_cpas.reading.png import SIGNATURE, Png, check_rows, png_parts
from pytest_cpas.types import Camera, ContractError, DataError

#: Formats of colours; and of depth and ids, which JPEG would change.
_LOSSY = ("PNG", "JPEG")
_LOSSLESS = ("PNG",)

#: Pixels of an image: three times those of the largest sensor of colour and depth there is.
MOST_PIXELS = 2**25

#: Largest file, bytes: so many pixels take as much without any compression.
_LARGEST = 2**27

#: Bytes of all channels of an EXR together.
_LARGEST_CHANNELS = 2**28


@contextmanager
def _opened(path: Path, *formats: str) -> Generator[tuple[Image.Image, Png | None]]:
    """The image, of one of ``formats`` (some of Pillow's others start programs), and its parts."""
    try:
        content = read_bytes(path, _LARGEST)
        png = png_parts(f"{path}", content) if content.startswith(SIGNATURE) else None
        if png is None and "JPEG" not in formats:
            raise DataError(
                f"{path}: not a readable image: it begins with {content[:8]!r}, which no PNG does,"
                " and depth and ids are read of nothing else; fetch it again"
            )
        if png is not None:  # before Pillow says what it thinks of large images
            _check_pixels(path, png.width, png.height)
        with Image.open(io.BytesIO(content), formats=formats) as image:
            _check_pixels(path, *image.size)
            yield image, png
    except ContractError:
        raise
    except Exception as error:  # a damaged image can make Pillow raise nearly anything
        reason = " ".join(str(error).split())
        raise DataError(
            f"{path}: not a readable image ({reason}); it is damaged or truncated, fetch it again"
        ) from error


def _check_pixels(path: Path, width: int, height: int) -> None:
    if width * height > MOST_PIXELS:
        raise DataError(f"{path}: {width} x {height} pixels, at most {MOST_PIXELS} in all are read")


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, without decoding the image."""
    with _opened(path, *_LOSSY) as (image, _):
        return image.size


def _read(
    path: Path, camera: Camera, modes: tuple[str, ...], what: str, formats: tuple[str, ...]
) -> NDArray[np.generic]:
    """Decode, once mode and size are known to be the right ones."""
    with _opened(path, *formats) as (image, png):
        if image.mode not in modes:
            raise DataError(
                f"{path}: image mode is {image.mode}, expected {' or '.join(modes)} ({what})"
            )
        if image.size != (camera.width, camera.height):
            raise DataError(
                f"{path}: {image.width} x {image.height} pixels, but the camera has"
                f" {camera.width} x {camera.height}"
            )
        if png is not None:
            check_rows(f"{path}", png)
        return np.asarray(image)


def read_rgb(path: Path, camera: Camera) -> NDArray[np.float32]:
    """8-bit colour as (H, W, 3) float32 in 0..1."""
    image = _read(path, camera, ("RGB", "RGBA"), "8-bit colour", _LOSSY)
    colour = image[:, :, :3].astype(np.float32)
    colour /= np.float32(255)
    return colour


def read_depth(path: Path, camera: Camera, per_metre: float = 1000.0) -> NDArray[np.float32]:
    """16-bit depth of which ``per_metre`` units are a metre, as (H, W) float32 metres.

    The channel D of an ``.exr`` is taken for metres; what is not a positive number is missing.
    """
    if path.suffix == ".exr":
        return _read_exr(path, camera)
    image = _read(path, camera, ("I;16", "I;16B"), "16-bit depth", _LOSSLESS)
    return image.astype(np.float32) / np.float32(per_metre)


def read_ids(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """8-bit instance ids (H, W); of a colour image the first channel (CAMERA25)."""
    modes = ("1", "L", "P", "RGB", "RGBA")
    image = _read(path, camera, modes, "8-bit instance ids", _LOSSLESS)
    ids: NDArray[np.uint8] = (image if image.ndim == 2 else image[:, :, 0]).astype(np.uint8)
    return ids


def _read_exr(path: Path, camera: Camera) -> NDArray[np.float32]:
    try:
        import OpenEXR
    except ImportError as error:
        raise DataError(
            f'{path}: reading OpenEXR images needs pip install "pytest-cpas[exr]" ({error})'
        ) from error
    try:
        with OpenEXR.File(str(regular(path)), header_only=True) as file:
            header = file.header()
            low, high = header["dataWindow"]
            count = len(header["channels"])
        width, height = (np.asarray(high) - np.asarray(low) + 1).tolist()
        if (width, height) != (camera.width, camera.height):
            raise DataError(
                f"{path}: {width} x {height} pixels, but the camera has"
                f" {camera.width} x {camera.height}"
            )
        _check_pixels(path, width, height)
        size = 4 * width * height * count
        if size > _LARGEST_CHANNELS:
            raise DataError(
                f"{path}: its {count} channels are up to {size} bytes, at most"
                f" {_LARGEST_CHANNELS} are read"
            )
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            if "D" not in channels:
                raise DataError(f"{path}: channels {sorted(channels)}, expected D")
            depth = np.array(channels["D"].pixels, dtype=np.float32)
    except ContractError:
        raise
    except Exception as error:
        raise DataError(
            f"{path}: not a readable image ({error}); it is damaged or truncated, fetch it again"
        ) from error
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
