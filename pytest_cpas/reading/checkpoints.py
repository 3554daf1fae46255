"""Tensors that others stored with torch; nothing in a checkpoint is run."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path
from typing import Any

from pytest_cpas.reading.files import opened
from pytest_cpas.types import DataError

#: Largest checkpoint, bytes.
LARGEST_CHECKPOINT = 2**34

#: By how much the members of a checkpoint may exceed the file, which torch never compresses, bytes.
_MARGIN = 2**20


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
            _check_size(path, file, size)
            file.seek(0)
            with warnings.catch_warnings():
                # of another pickle protocol; what it cannot read raises
                warnings.simplefilter("ignore", UserWarning)
                return torch.load(file, map_location="cpu", weights_only=True)
        except DataError:
            raise
        except Exception as error:  # torch's unpickler takes the end of a torn file as it comes
            reason = str(error).strip().splitlines()
            raise DataError(
                f"{path} ({size} bytes) cannot be read as tensors alone: it is damaged, torn, a web"
                " page, or it holds code, which is never run. Fetch it again"
                f" ({type(error).__name__}: {reason[0] if reason else 'no reason given'})"
            ) from error


def _check_size(path: Path, file: Any, size: int) -> None:
    if zipfile.is_zipfile(file):
        with zipfile.ZipFile(file) as archive:
            total = sum(info.file_size for info in archive.infolist())
        if total > size + _MARGIN:
            raise DataError(f"{path}: it would unpack to {total} bytes, from {size}; a bomb?")
