"""The report of a run of pytest."""

import json

import pytest
from report_schema import follow_schema


@pytest.fixture
def report(recorded, pytester):
    """The report of a method, as (JSON, Markdown), and what pytest said."""

    def run(method: str, *args: str, dataset: str = "Tiny"):
        result = recorded(method, "--cpas-report=out", *args, dataset=dataset)
        folder = pytester.path / "out"
        content = json.loads((folder / "report.json").read_text())
        follow_schema(content)
        assert sorted(path.name for path in folder.iterdir()) == [
            "precision.csv",
            "precision.tex",
            "report.html",
            "report.json",
            "report.md",
            "scores.csv",
        ]
        return content, (folder / "report.md").read_text(), result

    return run
