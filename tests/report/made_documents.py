"""Documents of the made-up runs of tests/tables.py."""

from report_schema import follow_schema
from tables import CPAS, a_run

from pytest_cpas.evaluation import Row, Run
from pytest_cpas.golden import RunTable
from pytest_cpas.golden.comparison import compare
from pytest_cpas.report.document import document, run_document


def a_run_document(run: Run, judged: list[Row], golden: RunTable | None = None, **more) -> dict:
    given = {
        "errors": {},
        "verdicts": compare(golden, RunTable.of(run, judged)),
        "require_golden": False,
        "contract": [],
        "findings": [],
        "golden": golden,
    }
    return run_document(run, RunTable.of(run, judged), **given | more)


def a_document(judged: list[Row], golden: RunTable | None = None, **more) -> dict:
    content = document([a_run_document(a_run(), judged, golden, **more)], 0, CPAS)
    follow_schema(content)
    return content
