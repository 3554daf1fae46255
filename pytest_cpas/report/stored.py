"""Reading back what was written of runs: reports and results files, as documents of runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast

from pytest_cpas.documents import Document, RunDocument
from pytest_cpas.evaluation import MergedRun, Row, SampleError, merge
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import Protocol
from pytest_cpas.reading.schemas import check_schema
from pytest_cpas.reading.structured import read_json
from pytest_cpas.report.consistency import check_consistency
from pytest_cpas.report.document import FORMAT, run_document
from pytest_cpas.report.rejudged import rejudged_run
from pytest_cpas.report.tables import labels
from pytest_cpas.types import ContractError, DataError, ToldError, shown

#: Largest file of a report, bytes: that of some hundred thousand samples.
LARGEST = 2**27

#: What of a sample has a character for each column.
_OUTCOMES: tuple[Literal["outcome", "golden"], ...] = ("outcome", "golden")


#: Lists, tables and keys of a document: a dozen for each of hundreds of thousands of samples.
_MOST_PARTS = 4_000_000


class StoredReportError(ToldError):
    """A file that is no report of this version, or that does not fit another one."""


def read_report(path: Path) -> Document:
    """The document in a ``report.json``; :class:`StoredReportError` if it holds none."""
    try:
        content = read_json(path, limit=LARGEST, most=_MOST_PARTS)
    except DataError as error:
        raise StoredReportError(str(error)) from error
    if "format" not in content:
        raise StoredReportError(f"{path}: not a report; expected the report.json of --cpas-report")
    if content["format"] != FORMAT:
        raise StoredReportError(
            f"{path}: format {shown(content['format'])}, this version reads {FORMAT}; write the"
            " report anew from the results files"
        )
    schema = read_json(Path(__file__).with_name("schema.json"))
    try:
        check_schema(schema, content, "its JSON")
        document = cast(Document, content)  # as the schema says
        _check_columns(path, document)
        check_consistency(document)
    except ContractError as error:  # DataError is one
        raise StoredReportError(
            f"{path}: --cpas-report of this version did not write it ({error})"
        ) from error
    return document


def _check_columns(path: Path, document: Document) -> None:
    columns = [*document["thresholds"], *document["guards"]]
    for run in document["runs"]:
        own = [*labels(run["precision"]), *labels(run["guards"])]
        outcomes = [text for s in run["samples"] for key in _OUTCOMES if (text := s[key])]
        if (own and own != columns) or any(len(text) != len(columns) for text in outcomes):
            raise StoredReportError(
                f"{path}: the columns of {run['method']} on {run['dataset']} are not those that it"
                f" says it was judged in: {'; '.join(columns)}"
            )


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
    names = Counter((run["method"], run["dataset"]) for run in runs)
    for (method, dataset), count in names.items():
        if count > 1:
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
