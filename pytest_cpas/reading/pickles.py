"""Reading the pickles that the field exchanges without running what is in them."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from pytest_cpas.reading.files import read_bytes
from pytest_cpas.reading.pickle_limits import MAX_FILE
from pytest_cpas.reading.pickle_loop import unpickle
from pytest_cpas.types import DataError

#: How files begin that are met in the place of pickles.
_PACKED = {
    b"PK\3\4": "a zip archive, as torch.save and numpy.savez write",
    b"\x1f\x8b": "gzip",
    b"BZh": "bzip2",
    b"\xfd7zXZ\0": "xz",
    b"\x28\xb5\x2f\xfd": "zstandard",
}
_UNPACK = "unpack it, or write what it holds with pickle.dump"


def load_numpy_pickle(path: Path) -> dict[str, Any]:
    """Read a pickled dict as :func:`load_pickle` does.

    Raises :class:`DataError` as it does, and if the file holds no dict.
    """
    value = load_pickle(path)
    if not isinstance(value, dict):
        raise DataError(f"{path}: holds a {type(value).__name__}, expected a dict of arrays")
    return value


def load_pickle(path: Path, classes: Collection[str] = ()) -> Any:
    """Read a pickle of builtins and numpy arrays; nothing that it names is ever called.

    ``classes``: those, ``module.name``, whose objects it may hold as well: each becomes a dict of
    its fields, and so do ``OrderedDict`` and ``Counter`` where there are some.

    Arrays and scalars are of booleans, integers, floats and complex numbers of at most 64 bits a
    part, of text or of bytes; arrays of objects hold plain values. Arrays are read-only. Text of
    Python 2 is taken as Latin 1. What is read is limited as :mod:`~.pickle_limits` says.

    Raises :class:`DataError` naming the file and the byte when it names anything else, is
    truncated, damaged or too large.
    """
    content = read_bytes(path, MAX_FILE)
    try:
        return unpickle(content, classes)
    except DataError as error:
        for magic, kind in _PACKED.items():
            if content.startswith(magic):
                raise DataError(f"{path}: {kind}, and no pickle; {_UNPACK}") from None
        raise DataError(f"{path}: {error}") from None
