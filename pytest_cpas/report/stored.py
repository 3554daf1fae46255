"""Reading back what was written of runs: reports and results files, as documents of runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast

from pytest_cpas.documents import Document, RunDocument
from pytest_cpas.evaluation import MergedRun, Row, SampleError, merge
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import Protocol
from pytest_cpas.reading.structured import read_json
from pytest_cpas.report.document import FORMAT, run_document
from pytest_cpas.report.rejudged import rejudged_run
from pytest_cpas.report.tables import labels
from pytest_cpas.types import DataError, ToldError

#: What of a sample has a character for each column.
_OUTCOMES: tuple[Literal["outcome", "golden"], ...] = ("outcome", "golden")


#: Lists, tables and keys of a document: a dozen for each of hundreds of thousands of samples.
_MOST_PARTS = 4_000_000


class StoredReportError(ToldError):
    """A file that is no report of this version, or that does not fit another one."""


def read_report(path: Path) -> Document:
    """The document in a ``report.json``; :class:`StoredReportError` if it holds none."""
    from jsonschema import Draft202012Validator  # slow to import
    from jsonschema.exceptions import best_match

    try:
        content = read_json(path, most=_MOST_PARTS)
    except DataError as error:
        raise StoredReportError(str(error)) from error
    if "format" not in content:
        raise StoredReportError(f"{path}: not a report; expected the report.json of --cpas-report")
    if content["format"] != FORMAT:
        raise StoredReportError(
            f"{path}: format {content['format']}, this version reads {FORMAT}; write the report"
            " anew from the results files"
        )
    schema = read_json(Path(__file__).with_name("schema.json"))
    wrong = best_match(Draft202012Validator(schema).iter_errors(content))
    if wrong is not None:
        raise StoredReportError(
            f"{path}: --cpas-report of this version did not write it ({wrong.json_path}:"
            f" {wrong.message[:200]})"
        )
    document = cast(Document, content)  # as the schema says
    columns = [*document["thresholds"], *document["guards"]]
    for run in document["runs"]:
        own = [*labels(run["precision"]), *labels(run["guards"])]
        outcomes = [text for s in run["samples"] for key in _OUTCOMES if (text := s[key])]
        if (own and own != columns) or any(len(text) != len(columns) for text in outcomes):
            raise StoredReportError(
                f"{path}: the columns of {run['method']} on {run['dataset']} are not those that it"
                f" says it was judged in: {'; '.join(columns)}"
            )
    return document


def read_runs(
    paths: Sequence[Path], protocols: Sequence[Protocol] | None = None
) -> list[RunDocument]:
    """The documents of the runs in reports (``.json``) and results files.

    They are judged under ``protocols``, where the rows have the facts; if None, results are judged
    under the paper's, and reports are as they were judged.
    The results files of the shards of a run are put together; parts may be missing. Raises
    :class:`StoredReportError`, and :class:`pytest_cpas.evaluation.results.ResultsError`.
    """
    reports = [path for path in paths if path.suffix == ".json"]
    results = [path for path in paths if path.suffix != ".json"]
    runs = [run for path in reports for run in read_report(path)["runs"]]
    if protocols is not None:
        runs = [rejudged_run(run, protocols) for run in runs]
    runs += [_judged(run) for run in merge(results, allow_gaps=True, protocols=protocols)]
    names = [(run["method"], run["dataset"]) for run in runs]
    for method, dataset in names:
        if names.count((method, dataset)) > 1:
            raise StoredReportError(f"{method} on {dataset} is in these files more than once")
    return runs


def _judged(run: MergedRun) -> RunDocument:
    rows: list[Row] = []
    errors: dict[str, str] = {}
    for ref in run.samples:
        try:
            rows.append(run.judge(ref))
        except SampleError as error:
            errors[ref.id] = str(error)
    return run_document(run, RunTable.of(run, rows), errors=errors)
