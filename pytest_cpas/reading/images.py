"""Reading images; every damage ends in a :class:`DataError` that names the file."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pytest_cpas.reading.files import opened, regular
from pytest_cpas.types import Camera, ContractError, DataError


@contextmanager
def _opened(path: Path) -> Generator[Image.Image]:
    try:
        # some of Pillow's other formats start programs
        with opened(path) as file, Image.open(file, formats=("PNG", "JPEG")) as image:
            yield image
    except ContractError:
        raise
    except Exception as error:  # a damaged image can make Pillow raise nearly anything
        reason = " ".join(str(error).split())
        raise DataError(
            f"{path}: not a readable image ({reason}); it is damaged or truncated, fetch it again"
        ) from error


def image_size(path: Path) -> tuple[int, int]:
    """Width and height, without decoding the image."""
    with _opened(path) as image:
        return image.size


def _read(path: Path, camera: Camera, modes: tuple[str, ...], what: str) -> NDArray[np.generic]:
    """Decode, once mode and size are known to be the right ones."""
    with _opened(path) as image:
        if image.mode not in modes:
            raise DataError(
                f"{path}: image mode is {image.mode}, expected {' or '.join(modes)} ({what})"
            )
        if image.size != (camera.width, camera.height):
            raise DataError(
                f"{path}: {image.width} x {image.height} pixels, but the camera has"
                f" {camera.width} x {camera.height}"
            )
        return np.asarray(image)


def read_rgb(path: Path, camera: Camera) -> NDArray[np.float32]:
    """8-bit colour as (H, W, 3) float32 in 0..1."""
    image = _read(path, camera, ("RGB", "RGBA"), "8-bit colour")
    return image[:, :, :3].astype(np.float32) / np.float32(255)


def read_depth(path: Path, camera: Camera, per_metre: float = 1000.0) -> NDArray[np.float32]:
    """16-bit depth of which ``per_metre`` units are a metre, as (H, W) float32 metres.

    The channel D of an ``.exr`` is taken for metres; what is not a positive number is missing.
    """
    if path.suffix == ".exr":
        return _read_exr(path, camera)
    image = _read(path, camera, ("I;16", "I;16B"), "16-bit depth")
    return image.astype(np.float32) / np.float32(per_metre)


def read_ids(path: Path, camera: Camera) -> NDArray[np.uint8]:
    """8-bit instance ids (H, W); of a colour image the first channel (CAMERA25)."""
    image = _read(path, camera, ("1", "L", "P", "RGB", "RGBA"), "8-bit instance ids")
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
            low, high = file.header()["dataWindow"]
        width, height = (np.asarray(high) - np.asarray(low) + 1).tolist()
        if (width, height) != (camera.width, camera.height):
            raise DataError(
                f"{path}: {width} x {height} pixels, but the camera has"
                f" {camera.width} x {camera.height}"
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
