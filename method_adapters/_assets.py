"""Files that methods need, and what is said when they are missing or wrong."""

from __future__ import annotations

import importlib.util
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pytest_cpas.adapting import CATEGORIES, Asset, ContractError, read_npy

#: The category priors, (6, 1024, 3) in NOCS units, that SPD, CR-Net, SGPA, DPDN and RBP-Pose share.
MEAN_SHAPES = Asset(
    path="mean_points_emb.npy",
    url="https://github.com/mentian/object-deformnet/raw/master/assets/mean_points_emb.npy",
    licence="MIT",
)
MEAN_SHAPES_MD5 = "3d183e58e2353e77c643d236ba7e575c"

#: On top of each checkpoint's own licence, or instead of it.
NOCS_TERMS = "trained on NOCS data, which is for non-commercial use"


class AssetError(ValueError):
    """A file of weights or priors is not what it should be."""


@contextmanager
def told_of_asset() -> Generator[None]:
    """What is wrong with a file that is read becomes an :class:`AssetError`."""
    try:
        yield
    except ContractError as error:
        raise AssetError(str(error)) from error


class Needy:
    """A method that needs more than the plugin; what it declares can be read without that."""

    #: The extra that has all of it; modules that are imported, and the packages that have them.
    extra: ClassVar[str] = "torch"
    packages: ClassVar[Sequence[tuple[str, str]]] = (("torch", "torch"),)

    def __init__(self) -> None:
        """Raises ModuleNotFoundError with what to install; nothing is imported."""
        lacking = [
            package for module, package in self.packages if importlib.util.find_spec(module) is None
        ]
        if lacking:
            raise ModuleNotFoundError(
                f"this method needs {' and '.join(lacking)}: pip install"
                f" 'pytest-cpas[{self.extra}]'"
            )


def load_priors(folder: Path | None) -> NDArray[np.float32]:
    """The mean shapes (6, 1024, 3), categories in the order of CATEGORIES.

    Raises FileNotFoundError, or :class:`AssetError` for a file that holds something else.
    """
    path = MEAN_SHAPES.locate(folder)
    expected = (
        f"expected {(len(CATEGORIES), 1024, 3)} finite numbers, each category about 1 in diagonal"
        f" (the published file has the md5 sum {MEAN_SHAPES_MD5})"
    )
    try:
        priors = read_npy(path)
    except ContractError as error:
        raise AssetError(f"{error}; {expected}") from error
    if priors.shape != (len(CATEGORIES), 1024, 3) or priors.dtype.kind != "f":
        raise AssetError(f"{path}: it holds {priors.shape} of {priors.dtype}; {expected}")
    diagonals = np.linalg.norm(np.ptp(priors, axis=1), axis=-1)
    if not np.all((diagonals > 0.5) & (diagonals < 2)):  # NaN is neither
        raise AssetError(f"{path}: the diagonals are {np.round(diagonals, 3)}; {expected}")
    single: NDArray[np.float32] = priors.astype(np.float32)
    return single
