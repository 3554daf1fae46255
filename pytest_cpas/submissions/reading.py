"""Which form a file of predictions has."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from pytest_cpas.submissions import nocs
from pytest_cpas.submissions.frames import Submission
from pytest_cpas.types import CATEGORIES, DataError

__all__ = ["read_submission"]


def read_submission(path: Path, classes: Sequence[str] = CATEGORIES) -> Submission:
    """Read a file of predictions, or a folder of them, in any form that is known.

    ``classes``: the category of each class id, from 1. Raises :class:`DataError` naming the file
    that is damaged or in no form that is known.
    """
    if os.path.isdir(path):  # which takes names that are too long
        if not any(path.glob("*.pkl")):
            raise DataError(f"{path}: no .pkl files in this folder")
    elif path.suffix not in (".npz", ".pkl"):
        raise DataError(f"{path}: expected a .pkl, a folder of them, or an .npz")
    return nocs.read(path, classes)
