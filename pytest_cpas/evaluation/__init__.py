"""Method times data set gives rows, one per sample; rows give the table."""

from pytest_cpas.datasets.perturbed import RobustnessPoint
from pytest_cpas.evaluation.batches import batches_of
from pytest_cpas.evaluation.detected_runs import DetectedRun
from pytest_cpas.evaluation.estimates import (
    Estimates,
    decode_estimates,
    decode_hypothesis,
    decode_shape,
    encode_estimate,
    encode_shape,
)
from pytest_cpas.evaluation.measuring import measure
from pytest_cpas.evaluation.merging import MergedRun, merge
from pytest_cpas.evaluation.method_process import MethodProcess
from pytest_cpas.evaluation.method_runs import MethodError, MethodRun, check_answers
from pytest_cpas.evaluation.opened import OWN, digest_of_opened, opened_name
from pytest_cpas.evaluation.predictions import StoredRun
from pytest_cpas.evaluation.program import found_programs, take_programs
from pytest_cpas.evaluation.results import (
    Header,
    Results,
    ResultsError,
    Shard,
    read_results,
)
from pytest_cpas.evaluation.results_file import ResultsFile
from pytest_cpas.evaluation.revisions import Adapter, Revision, RevisionError
from pytest_cpas.evaluation.rows import Answer, Answered, Row
from pytest_cpas.evaluation.runs import Run, SampleError, Selection, kernels
from pytest_cpas.evaluation.saving import SavedAnswers
from pytest_cpas.evaluation.served_method import write_observations
from pytest_cpas.evaluation.surroundings import (
    is_installed,
    is_left_out,
    leave_out,
    named,
)
from pytest_cpas.evaluation.watchdog import Limit, Watchdog, can_watch, parse_seconds

__all__ = [
    "OWN",
    "Adapter",
    "Answer",
    "Answered",
    "DetectedRun",
    "Estimates",
    "Header",
    "Limit",
    "MergedRun",
    "MethodError",
    "MethodProcess",
    "MethodRun",
    "Results",
    "ResultsError",
    "ResultsFile",
    "Revision",
    "RevisionError",
    "RobustnessPoint",
    "Row",
    "Run",
    "SampleError",
    "SavedAnswers",
    "Selection",
    "Shard",
    "StoredRun",
    "Watchdog",
    "batches_of",
    "can_watch",
    "check_answers",
    "decode_estimates",
    "decode_hypothesis",
    "decode_shape",
    "digest_of_opened",
    "encode_estimate",
    "encode_shape",
    "found_programs",
    "is_installed",
    "is_left_out",
    "kernels",
    "leave_out",
    "measure",
    "merge",
    "named",
    "opened_name",
    "parse_seconds",
    "read_results",
    "take_programs",
    "write_observations",
]
