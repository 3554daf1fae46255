"""What the harness hands to a method, and what it takes back.

Conventions (everywhere in this package, adapters convert at their own border):

* lengths in metres, float64;
* camera frame: OpenCV (x right, y down, z forward), pixel centres at integers;
* object frame: ShapeNet (y up, origin in the centre of the object's axis-aligned bounding box);
* a pose maps object coordinates to camera coordinates: ``x_camera = R @ x_object + t``.

Everything is validated on entry and raises :class:`ContractError` with what was seen, what was
expected and what to look for in an adapter: as :class:`DataError`, :class:`AnswerError` or
:class:`DeclarationError` where it is known whose value it is.
"""

from pytest_cpas.types._arrays import Array
from pytest_cpas.types.answers import Hypothesis, Prediction
from pytest_cpas.types.datasets import Dataset, WrappedDataset, as_dataset
from pytest_cpas.types.declarations import EQUIVARIANCES, Asset, Method, MethodInfo, assets_of
from pytest_cpas.types.derived import Derived
from pytest_cpas.types.errors import (
    AnswerError,
    ContractError,
    DataError,
    DeclarationError,
    ToldError,
    message_of,
    raised_as,
    shortened,
    shown,
    some_of,
    words_of,
)
from pytest_cpas.types.geometry import Camera, Mesh, Pose, Symmetry
from pytest_cpas.types.samples import (
    CATEGORIES,
    GroundTruth,
    Observation,
    Sample,
    SampleRef,
)
from pytest_cpas.types.verdicts import ItemOutcome, Required, Verdict, VerdictWord

__all__ = [
    "CATEGORIES",
    "EQUIVARIANCES",
    "AnswerError",
    "Array",
    "Asset",
    "Camera",
    "ContractError",
    "DataError",
    "Dataset",
    "DeclarationError",
    "Derived",
    "GroundTruth",
    "Hypothesis",
    "ItemOutcome",
    "Mesh",
    "Method",
    "MethodInfo",
    "Observation",
    "Pose",
    "Prediction",
    "Required",
    "Sample",
    "SampleRef",
    "Symmetry",
    "ToldError",
    "Verdict",
    "VerdictWord",
    "WrappedDataset",
    "as_dataset",
    "assets_of",
    "message_of",
    "raised_as",
    "shortened",
    "shown",
    "some_of",
    "words_of",
]
