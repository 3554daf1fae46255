"""A table in the terminal."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

#: A run, or a check, of at most this many samples shows each of them.
FEW = 20


def print_table(terminal: pytest.TerminalReporter, lines: Sequence[Sequence[str]]) -> None:
    """Print rows of cells, the first column to the left, the others to the right."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    for line in lines:
        first = line[0].ljust(widths[0])
        rest = [cell.rjust(width) for cell, width in zip(line[1:], widths[1:], strict=True)]
        terminal.write_line("  ".join([first, *rest]).rstrip())
    terminal.write_line("")
