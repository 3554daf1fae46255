"""What a PNG is made of: Pillow takes rows that are not there for zeros, and reads any number of
chunks."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import NamedTuple

from pytest_cpas.types import DataError

SIGNATURE = b"\x89PNG\r\n\x1a\n"

#: Chunks of a file. Writers put 8 KiB of an image into one, or more.
MOST_CHUNKS = 2**16

#: Values of a pixel by type of colour.
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}

#: First column and row, and steps, of the passes of an interlaced image.
_PASSES = (
    (0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2),
    (0, 1, 1, 2),
)  # fmt: skip

_STEP = 2**20


class Png(NamedTuple):
    """The size of an image, in pixels, and of its rows, bytes; its compressed parts."""

    width: int
    height: int
    size: int
    parts: list[bytes]


def png_parts(where: str, content: bytes) -> Png:
    """The parts of a PNG; :class:`DataError` that begins with ``where`` if it has too many chunks,
    or no header."""
    width, height, depth, colour, interlaced = _header(where, content)
    passes = _PASSES if interlaced else ((0, 0, 1, 1),)
    size = 0
    for column, row, step_x, step_y in passes:
        across = max(0, -(-(width - column) // step_x))
        down = max(0, -(-(height - row) // step_y))
        size += down * (1 + -(-across * _CHANNELS[colour] * depth // 8)) if across else 0
    parts = [body for kind, body in _chunks(where, content) if kind == b"IDAT"]
    return Png(width, height, size, parts)


def check_rows(where: str, image: Png) -> None:
    """Raise :class:`DataError` that begins with ``where`` if rows are missing or damaged.

    It decodes a step at a time."""
    decoder = zlib.decompressobj()
    found = 0
    try:
        for part in image.parts:
            while part and found < image.size and not decoder.eof:
                found += len(decoder.decompress(part, _STEP))
                part = decoder.unconsumed_tail
    except zlib.error as error:
        raise DataError(
            f"{where}: not a readable image: its pixels are damaged ({error}), fetch it again"
        ) from None
    if found < image.size:
        raise DataError(
            f"{where}: not a readable image: truncated, {found} of {image.size} bytes of its pixels"
            " are there; fetch it again"
        )


def _header(where: str, content: bytes) -> tuple[int, int, int, int, int]:
    """Width, height, bits of a value, type of colour, and whether it is interlaced."""
    if content[12:16] != b"IHDR" or len(content) < 33:
        raise DataError(
            f"{where}: not a readable image: it does not begin with the header of a PNG; fetch it"
            " again"
        )
    width, height = (int.from_bytes(content[at : at + 4], "big") for at in (16, 20))
    depth, colour, _, _, interlaced = content[24:29]
    if not (width and height) or colour not in _CHANNELS or depth not in (1, 2, 4, 8, 16):
        raise DataError(
            f"{where}: not a readable image: its header says {width} x {height} pixels of {depth}"
            f" bits, colour {colour}; fetch it again"
        )
    return width, height, depth, colour, interlaced


def _chunks(where: str, content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each chunk, of the last one as far as it is there."""
    at = len(SIGNATURE)
    for _ in range(MOST_CHUNKS):
        if at + 8 > len(content):
            return
        length = int.from_bytes(content[at : at + 4], "big")
        yield content[at + 4 : at + 8], content[at + 8 : at + 8 + length]
        at += 12 + length
    raise DataError(
        f"{where}: not a readable image: it has more than {MOST_CHUNKS} chunks, the most read"
    )
