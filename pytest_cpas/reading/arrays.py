"""Arrays in ``.npy`` and ``.npz`` files: plain ones, of the shapes and kinds that are needed.

The headers are parsed here, not evaluated; nothing is unpickled. A header, the size that the
archive declares and the bytes that come out must agree before an array is made of them, so that a
small file cannot become a large one.
"""

from __future__ import annotations

import math
import os
import re
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.reading.files import opened
from pytest_cpas.reading.zips import open_zip
from pytest_cpas.types import DataError

#: All arrays of a file together, bytes: half a million objects' poses are a tenth of it.
LARGEST_ARRAYS = 2**28

#: Members of an archive.
MOST_ARRAYS = 10_000

#: Bytes of a header; that of a plain array has 128.
_LONGEST_HEADER = 4096

#: Bytes of one text in an array of texts, and dimensions.
_LONGEST_TEXT = 4096
_MOST_DIMENSIONS = 8

_KIND_WORDS = {
    "b": "truth values",
    "i": "integers",
    "u": "integers",
    "f": "real numbers",
    "U": "texts",
    "S": "bytes",
}

_NOT_PLAIN = "its values are no plain numbers or texts, and nothing is unpickled"

_DTYPE = re.compile(r"[<>|=]?(?:b1|[iu][1248]|f(?:2|4|8|16)|[SU][1-9]\d{0,4})")
_ENTRY = re.compile(
    r"""\s*+(["'])(\w+)\1\s*+:\s*+(?:(["'])([^"']*+)\3|(True|False)|\(([\d\s,L]*+)\))\s*+,?"""
)


@dataclass(frozen=True)
class Wanted:
    """What an array must be: ``kinds`` of its dtype (``"iuf"``), and its ``shape``, where None
    stands for any length; without a shape, one of at least one dimension. ``optional``: it need
    not be there."""

    kinds: str
    shape: tuple[int | None, ...] | None = None
    optional: bool = False

    def check(self, where: str, array: NDArray[Any]) -> None:
        """Raises :class:`DataError` that begins with ``where``."""
        have, want = array.shape, self.shape
        fits = (
            len(have) > 0
            if want is None
            else have == want
            or (
                len(have) == len(want)
                and all(w in (None, h) for w, h in zip(want, have, strict=True))
            )
        )
        if array.dtype.kind not in self.kinds or not fits:
            shape = "N, ..." if want is None else ", ".join(str(n or "N") for n in want)
            words = " or ".join(dict.fromkeys(_KIND_WORDS[kind] for kind in self.kinds))
            raise DataError(
                f"{where}: {have} of {array.dtype}, expected {words} of shape ({shape})"
            )


def read_npy(path: Path) -> NDArray[Any]:
    """The array in a ``.npy`` file; :class:`DataError` naming it if there is no plain one."""
    with opened(path, LARGEST_ARRAYS + _LONGEST_HEADER) as file:
        array = _read_array(f"{path}", file, os.fstat(file.fileno()).st_size)
    if array is None:
        raise DataError(f"{path}: {_NOT_PLAIN}")
    return array


def read_npz(
    path: Path, wanted: Mapping[str, Wanted] | None = None, source: BinaryIO | None = None
) -> dict[str, NDArray[Any]]:
    """The plain arrays of an ``.npz`` file by name: those ``wanted``, or all that are.

    ``source``: the file, if it is open or in memory already. Raises :class:`DataError` naming
    the file and the array if one is missing, damaged or another than wanted.
    """
    if source is None:
        with opened(path, LARGEST_ARRAYS) as file:
            return read_npz(path, wanted, file)
    try:
        with open_zip(f"{path}", source, MOST_ARRAYS) as archive:
            members = _members(path, archive, wanted)
            arrays = {}
            for name, info in members.items():
                with archive.open(info) as member:
                    array = _read_array(f"{path}, array {name}", member, info.file_size)
                if wanted is not None:
                    if array is None:
                        raise DataError(f"{path}, array {name}: {_NOT_PLAIN}")
                    wanted[name].check(f"{path}, array {name}", array)
                if array is not None:
                    arrays[name] = array
            return arrays
    except DataError:
        raise
    except (
        OSError,
        EOFError,
        ValueError,
        KeyError,
        IndexError,
        OverflowError,
        RuntimeError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise DataError(
            f"{path}: not a readable .npz ({' '.join(str(error).split())}); is it torn, or a web"
            " page? Fetch it again"
        ) from error


def _members(
    path: Path, archive: zipfile.ZipFile, wanted: Mapping[str, Wanted] | None
) -> dict[str, zipfile.ZipInfo]:
    """The members that hold the arrays that are wanted, or any, in the order of the names."""
    found: dict[str, zipfile.ZipInfo] = {}
    for info in archive.infolist():
        name = info.filename.removesuffix(".npy")
        if wanted is not None and name not in wanted:
            continue
        if name in found:
            raise DataError(f"{path}: array {name[:80]!r} is there twice")
        if info.flag_bits & 1:
            raise DataError(f"{path}, array {name[:80]!r}: it is encrypted")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise DataError(
                f"{path}, array {name[:80]!r}: compressed by method {info.compress_type}, expected"
                " 0 or 8, which numpy writes"
            )
        found[name] = info
    needed = [name for name, want in (wanted or {}).items() if not want.optional]
    if absent := sorted(set(needed) - set(found)):
        raise DataError(f"{path}: lacks {', '.join(absent)}")
    total = sum(info.file_size for info in found.values())
    if total > LARGEST_ARRAYS:
        raise DataError(
            f"{path}: it would unpack to {total} bytes, at most {LARGEST_ARRAYS} are read; a bomb?"
        )
    return {name: found[name] for name in (found if wanted is None else wanted) if name in found}


def _read_array(where: str, file: IO[bytes], size: int) -> NDArray[Any] | None:
    """The array in a file of ``size`` bytes; None where it would have to be unpickled."""
    start = file.read(12)
    if start[:6] != b"\x93NUMPY" or start[6:7] not in (b"\1", b"\2", b"\3") or len(start) < 12:
        raise DataError(f"{where}: not an array of numpy, {start[:8]!r} at its beginning")
    width = 2 if start[6] == 1 else 4
    length = int.from_bytes(start[8 : 8 + width], "little")
    if length > _LONGEST_HEADER:
        raise DataError(f"{where}: a header of {length} bytes, at most {_LONGEST_HEADER} are read")
    header = start[8 + width :] + file.read(8 + width + length - len(start))
    dtype, fortran, shape = _parse_header(where, header)
    if dtype is None:
        return None
    expected, there = math.prod(shape) * dtype.itemsize, size - 8 - width - length
    if expected != there or max(shape, default=0) > LARGEST_ARRAYS:
        raise DataError(f"{where}: {shape} of {dtype} are {expected} bytes, and {there} are there")
    # one byte more shows where it ends
    content = file.read(expected + 1)
    if len(content) != expected:
        raise DataError(f"{where}: torn, {len(content)} of {expected} bytes are there")
    array = np.frombuffer(bytearray(content), dtype).reshape(shape, order="F" if fortran else "C")
    if dtype.kind == "b" and array.size and array.view(np.uint8).max() > 1:
        raise DataError(f"{where}: truth values other than 0 and 1")
    if dtype.kind == "U" and array.size:
        points = np.frombuffer(content, "<u4" if dtype.str[0] == "<" else ">u4")
        if points.max() > 0x10FFFF:
            raise DataError(f"{where}: characters that there are not")
    return array


def _parse_header(where: str, header: bytes) -> tuple[np.dtype[Any] | None, bool, tuple[int, ...]]:
    """dtype (None: not a plain one), whether in Fortran's order, and shape."""
    text = header.decode("latin-1").strip()
    entries: dict[str, str] = {}
    at = 1
    while match := _ENTRY.match(text, at):
        entries[match[2]] = next(g for g in (match[4], match[5], match[6]) if g is not None)
        at = match.end()
    simple = text[:1] == "{" and text[at:].strip() == "}" and len(entries) == 3
    if not simple and re.search(r"""["']descr["']\s*:\s*\[""", text):
        return None, False, ()  # columns of different kinds
    try:
        kind, order, sizes = (entries[key] for key in ("descr", "fortran_order", "shape"))
        shape = tuple(int(n.strip().removesuffix("L")) for n in sizes.split(",") if n.strip())
    except (KeyError, ValueError):
        simple = False
    if not simple or order not in ("True", "False") or len(shape) > _MOST_DIMENSIONS:
        raise DataError(f"{where}: the header {text[:100]!r} is not one of a plain array")
    if not _DTYPE.fullmatch(kind):
        return None, False, ()
    try:
        dtype = np.dtype(kind)
    except TypeError:  # a number of 16 bytes, which not every machine has
        return None, False, ()
    if dtype.itemsize > _LONGEST_TEXT:
        raise DataError(f"{where}: texts of {dtype.itemsize} bytes, at most {_LONGEST_TEXT}")
    return dtype, order == "True", shape
