"""The terminal, and a table in it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from pytest_cpas.reading.text import terminal_line

#: A run, or a check, of at most this many samples shows each of them.
FEW = 20


class Terminal:
    """pytest's terminal reporter, for lines with text from outside: the only way to it."""

    def __init__(self, reporter: pytest.TerminalReporter) -> None:
        self._reporter = reporter
        self.config = reporter.config

    def section(self, title: str) -> None:
        """Write a title across the terminal."""
        self._reporter.section(terminal_line(title), bold=True)

    def write_line(self, text: str, **markup: bool) -> None:
        """Write one line."""
        self._reporter.write_line(terminal_line(text), **markup)

    def interject(self, text: str) -> None:
        """Write one line between the results of items."""
        self._reporter.ensure_newline()
        if self.config.get_terminal_writer().width_of_current_line:
            self._reporter.line("")  # with xdist, dots stand on a line that pytest does not know
        self.write_line(text)

    def write_table(self, lines: Sequence[Sequence[str]]) -> None:
        """Write rows of cells, the first column to the left, the others to the right."""
        lines = [[terminal_line(cell) for cell in line] for line in lines]
        widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
        for line in lines:
            first = line[0].ljust(widths[0])
            rest = [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
            self.write_line("  ".join([first, *rest]).rstrip())
        self.write_line("")
