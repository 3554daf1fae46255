"""Tensors that others stored with torch; nothing in a checkpoint is run."""

from __future__ import annotations

import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

from pytest_cpas.reading.files import opened
from pytest_cpas.reading.pickle_walk import walk
from pytest_cpas.reading.zips import open_zip
from pytest_cpas.types import DataError

#: Largest checkpoint, bytes.
LARGEST_CHECKPOINT = 2**34

#: By how much the members of a checkpoint may exceed the file, which torch never compresses, bytes.
_MARGIN = 2**20

#: Tensors, and what is told of them. Large models have some thousand.
_MOST_MEMBERS = 100_000

#: Bytes of what is not tensors: 10,000 of them have two million.
_LARGEST_PICKLES = 2**26

#: Before torch 1.6 a file was so many pickles, and then the tensors.
_OLD_PICKLES = 5


def read_tensors(path: Path) -> Any:
    """What a checkpoint holds: tensors, on the CPU, in plain containers.

    Raises :class:`DataError` naming ``path`` for what is no file, is damaged, or holds anything
    else; ModuleNotFoundError without torch.
    """
    import torch

    with opened(path, LARGEST_CHECKPOINT) as file:
        size = file.seek(0, 2)
        file.seek(0)
        try:
            _check(path, file, size)
            file.seek(0)
            with warnings.catch_warnings():
                # of another pickle protocol; what it cannot read raises
                warnings.simplefilter("ignore", UserWarning)
                content = torch.load(file, map_location="cpu", weights_only=True)
            for tensor in _tensors(content, torch.Tensor):
                dense = tensor.layout == torch.strided and not tensor.is_meta
                needs = tensor.numel() * tensor.element_size()
                if not dense or needs > size:
                    raise DataError(
                        f"{path}: a tensor of shape {tuple(tensor.shape)} needs {needs} bytes, and"
                        f" the file has {size}; expected tensors that hold all of their values"
                    )
            return content
        except DataError:
            raise
        except Exception as error:  # torch's unpickler takes the end of a torn file as it comes
            reason = str(error).strip().splitlines()
            told = f"{type(error).__name__}: {reason[0] if reason else 'no reason given'}"
            raise DataError(_unreadable(f"{path}", size, told)) from error


def _unreadable(where: str, size: int, reason: str) -> str:
    return (
        f"{where} ({size} bytes) cannot be read as tensors alone: it is damaged, torn, a web page,"
        f" or it holds code, which is never run. Fetch it again ({reason})"
    )


def _tensors(content: Any, kind: type) -> Iterator[Any]:
    """The tensors in plain containers, each container once."""
    seen: set[int] = set()
    left = [content]
    while left:
        value = left.pop()
        if isinstance(value, kind):
            yield value
        elif isinstance(value, dict | list | tuple) and id(value) not in seen:
            seen.add(id(value))
            left += value.values() if isinstance(value, dict) else value


def _check(path: Path, file: BinaryIO, size: int) -> None:
    """Raise :class:`DataError` for what would keep torch busy, or fill the memory."""
    if not zipfile.is_zipfile(file):
        file.seek(0)
        _walk(f"{path}", file.read(_LARGEST_PICKLES), _OLD_PICKLES, size)
        return
    with open_zip(f"{path}", file, _MOST_MEMBERS) as archive:
        infos = archive.infolist()
        total = sum(info.file_size for info in infos)
        if total > size + _MARGIN:
            raise DataError(f"{path}: it would unpack to {total} bytes, from {size}; a bomb?")
        if len({info.filename for info in infos}) < len(infos):
            raise DataError(f"{path}: a member is there twice; fetch it again")
        for info in infos:
            if info.filename.rpartition("/")[2] == "data.pkl":
                if info.file_size > _LARGEST_PICKLES:
                    raise DataError(
                        f"{path}, {info.filename}: {info.file_size} bytes, at most"
                        f" {_LARGEST_PICKLES} are read"
                    )
                _walk(f"{path}, {info.filename}", archive.read(info), 1, size)


def _walk(where: str, content: bytes, count: int, size: int) -> None:
    """Go through so many pickles, one after the other, of a file of ``size`` bytes."""
    at = 0
    try:
        for _ in range(count):
            at = walk(content, at)
    except DataError as error:
        raise DataError(_unreadable(where, size, str(error))) from None
