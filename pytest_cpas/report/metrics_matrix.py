"""What implementations of metrics keep: the matrix implementation x property, in three forms."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pytest_cpas._files import write_file
from pytest_cpas.checks.metrics.properties import PROPERTIES
from pytest_cpas.checks.metrics.running import Result
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.reading.text import markdown, markdown_fence

__all__ = ["Cell", "as_json", "as_markdown", "as_table", "write_matrix"]


@dataclass(frozen=True)
class Cell:
    """A result, and whether it is the one that was recorded."""

    result: Result
    expected: bool

    @property
    def words(self) -> str:
        """``passed``, ``n/a``, or the finding; ``(known)`` behind one that was recorded."""
        known = " (known)" if self.expected and self.result.outcome is not Outcome.PASSED else ""
        return f"{self.result.outcome.value}{known}"


Matrix = Mapping[str, Mapping[str, Cell]]


def as_table(matrix: Matrix) -> list[list[str]]:
    """Rows of cells, the first the heading; properties that nobody offers are left out."""
    names = [
        name
        for name in PROPERTIES
        if any(
            name in cells and cells[name].result.outcome is not Outcome.NOT_OFFERED
            for cells in matrix.values()
        )
    ]
    rows = [["property", *matrix]]
    for name in names:
        cells = [column[name].words if name in column else "-" for column in matrix.values()]
        rows.append([name, *cells])
    return rows


def as_json(matrix: Matrix) -> str:
    """Everything, findings with case and snippet."""
    content: dict[str, Any] = {
        "properties": {
            p.name: {"statement": p.statement, "reason": p.reason} for p in PROPERTIES.values()
        },
        "subjects": {
            subject: {
                name: {
                    key: value
                    for key, value in asdict(cell.result).items()
                    if key not in ("subject", "property")
                }
                | {"known": cell.expected}
                for name, cell in cells.items()
            }
            for subject, cells in matrix.items()
        },
    }
    return json.dumps(content, indent=1)


def as_markdown(matrix: Matrix) -> str:
    """A table, and below it the findings with their snippets."""
    rows = as_table(matrix)
    lines = ["| " + " | ".join(map(markdown, row)) + " |" for row in rows]
    lines.insert(1, "|" + "---|" * len(rows[0]))
    for subject, cells in matrix.items():
        for name, cell in cells.items():
            if cell.result.snippet:
                lines += [
                    "",
                    f"**{markdown(subject)}, {name}: {cell.words}.** {PROPERTIES[name].statement}.",
                    "",
                    *markdown_fence([cell.result.snippet], "python"),
                ]
    return "\n".join(lines) + "\n"


def write_matrix(path: Path, matrix: Matrix) -> None:
    """Write JSON or Markdown, by the file's ending."""
    render = as_markdown if path.suffix == ".md" else as_json
    write_file(path, render(matrix))


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The rows as lines of equal columns."""
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]
