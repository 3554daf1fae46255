"""Files of predictions in the forms that the field writes, beside the truth that they answer."""

from pytest_cpas.submissions.answers import (
    box_at,
    failures,
    hypothesis,
    in_half_precision,
    names,
    order,
    score_at,
)
from pytest_cpas.submissions.audit import audit
from pytest_cpas.submissions.bop_csv import HEADER as BOP_HEADER
from pytest_cpas.submissions.bop_csv import line as bop_line
from pytest_cpas.submissions.detections import DetectedDataset, Found, without_detections
from pytest_cpas.submissions.frames import Answers, Image, Submission, Truths
from pytest_cpas.submissions.jsonl import Given, Header, answer_line
from pytest_cpas.submissions.pairing import Pairing
from pytest_cpas.submissions.reading import read_submission
from pytest_cpas.submissions.truth import OwnTruth, symmetry_in_view, truth_of
from pytest_cpas.submissions.writing import UNWRITTEN, write_submission

__all__ = [
    "BOP_HEADER",
    "UNWRITTEN",
    "Answers",
    "DetectedDataset",
    "Found",
    "Given",
    "Header",
    "Image",
    "OwnTruth",
    "Pairing",
    "Submission",
    "Truths",
    "answer_line",
    "audit",
    "bop_line",
    "box_at",
    "failures",
    "hypothesis",
    "in_half_precision",
    "names",
    "order",
    "read_submission",
    "score_at",
    "symmetry_in_view",
    "truth_of",
    "without_detections",
    "write_submission",
]
