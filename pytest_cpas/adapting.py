"""What an adapter imports of pytest-cpas: everything that it may need, and nothing else.

It is light: no torch, no Open3D, and scipy only with :func:`sample_surface`. So a method can be
listed, and say which weights it lacks, before anything heavy is imported.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from pytest_cpas._open3d import import_open3d
from pytest_cpas.reading.arrays import read_npy, read_npz
from pytest_cpas.reading.checkpoints import read_tensors
from pytest_cpas.reading.structured import read_yaml
from pytest_cpas.similarity import NoSimilarityError, Similarity, robust_umeyama, umeyama
from pytest_cpas.stages import TorchTaps, draw, heard_by, stage, tap
from pytest_cpas.types import (
    CATEGORIES,
    EQUIVARIANCES,
    AnswerError,
    Array,
    Asset,
    Camera,
    ContractError,
    Hypothesis,
    Mesh,
    Method,
    MethodInfo,
    Observation,
    Pose,
    Prediction,
    Symmetry,
)
from pytest_cpas.types.frames import (
    NOCS_FROM_SHAPENET,
    OPENCV_FROM_OPENGL,
    SHAPENET_FROM_Z_UP,
    permute_extents,
)

if TYPE_CHECKING:
    from pytest_cpas.metrics import sample_surface

__all__ = [
    "CATEGORIES",
    "EQUIVARIANCES",
    "NOCS_FROM_SHAPENET",
    "OPENCV_FROM_OPENGL",
    "SHAPENET_FROM_Z_UP",
    "AnswerError",
    "Array",
    "Asset",
    "Camera",
    "ContractError",
    "Hypothesis",
    "Mesh",
    "Method",
    "MethodInfo",
    "NoSimilarityError",
    "Observation",
    "Pose",
    "Prediction",
    "Similarity",
    "Symmetry",
    "TorchTaps",
    "draw",
    "heard_by",
    "import_open3d",
    "permute_extents",
    "read_npy",
    "read_npz",
    "read_tensors",
    "read_yaml",
    "robust_umeyama",
    "sample_surface",
    "stage",
    "tap",
    "umeyama",
]

if not TYPE_CHECKING:  # a type checker would take every name for one that there is

    def __getattr__(name: str) -> object:
        if name != "sample_surface":
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from pytest_cpas.metrics import sample_surface

        return sample_surface


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
