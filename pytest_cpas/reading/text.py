r"""Text from outside, escaped for where it goes: one function per destination.

Text is from outside if a file, a method, a data set or a server wrote it: ids of samples, names of
categories and frames, reasons of failures, messages of exceptions, licences. It is kept as it is
(in rows, results files, ``report.json``) and escaped where it leaves, once, by the last that writes
it. What cannot be seen becomes the escape sequence of a Python string, such as ``\x1b`` or
``\u202e``, everywhere. A backslash stays a backslash, so whoever escapes twice changes nothing,
and ``\x1b`` in the output may also be what the text had.

Names that become files or folders are not escaped but refused: see
:func:`pytest_cpas.types.names.checked_name`.
"""

from __future__ import annotations

import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import IO, Any

__all__ = [
    "WIDTH",
    "csv_cell",
    "csv_text",
    "encodable",
    "encodable_values",
    "everywhere",
    "folded",
    "html",
    "latex",
    "markdown",
    "markdown_fence",
    "say",
    "terminal_line",
    "terminal_lines",
]

#: Characters of a line of a terminal that is read at a glance.
WIDTH = 100

#: What has no width although Python calls it printable: joiners, fillers, variation selectors.
_UNSEEN = re.compile(
    "[\u034f\u115f\u1160\u17b4\u17b5\u180b-\u180f\u3164\ufe00-\ufe0f\uffa0\U000e0100-\U000e01ef]"
)

#: What a CI service takes for a command: GitHub's ``::`` first in a line, whatever space is before
#: it; ``##[``, ``##vso[``, ``##teamcity[`` of GitHub, Azure and TeamCity wherever they stand.
_COMMAND = re.compile(r"^([ \t]*):(?=:)", re.MULTILINE)
_OLD_COMMAND = re.compile(r"##(?=[\w.-]*\[)")

#: What a spreadsheet takes for a formula if a cell begins with it, and in some languages its wide
#: forms; and the apostrophe, so that one that was added is told from one that was there.
_FORMULA = tuple("=+-@'＝＋－＠")

#: What LaTeX takes for a command.
_LATEX = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"{\char34}",
    # after the end of a line these would be its arguments
    "[": "{[}",
    "*": "{*}",
    **{character: "\\" + character for character in "&%$#_{}"},
}


def terminal_line(text: str) -> str:
    """One line of a terminal or of a log: whatever ``text`` holds begins no other one."""
    return _no_command(_seen(text))


def terminal_lines(text: str) -> str:
    """Several lines of a terminal or of a log, with the tabs in them."""
    return _no_command(_seen(text.replace("\r\n", "\n"), keep="\n\t"))


def folded(text: str) -> str:
    """Text of which no line is longer than :data:`WIDTH`, as far as it has spaces; what a line goes
    on with is set in."""
    lines: list[str] = []
    for line in text.split("\n"):
        indent = " " * (len(line) - len(line.lstrip(" ")) + 4)
        lines += (
            [line]
            if len(line) <= WIDTH
            else textwrap.wrap(
                line,
                WIDTH,
                subsequent_indent=indent,
                expand_tabs=False,
                replace_whitespace=False,
                break_long_words=False,
                break_on_hyphens=False,
            )
        )
    return "\n".join(lines)


def say(*texts: object, file: IO[str] | None = None) -> None:
    """Print lines where pytest's terminal reporter does not: of ``file``, or standard output."""
    print(terminal_lines("\n".join(map(str, texts))), file=file or sys.stdout)


def markdown(text: str) -> str:
    """Text within a paragraph, a heading or a cell of a table in GitHub's Markdown, in one line.

    It names nobody, links nothing and loads nothing: what would has an empty comment in it.
    """
    text = _no_command(_seen(" ".join(text.split())))
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([\\`*_\[\]#!|~])", r"\\\1", text)
    # what would begin a list, a line across or a heading, where it is first in a line
    text = re.sub(r"^([-+=]|\d+(?=[.)]))", lambda m: _first(m[0]), text)
    return re.sub(r"(?i)(@|#|://|www(?=\.))(?=[\w.-])", r"\1<!-- -->", text)


def _first(text: str) -> str:
    return f"{text}<!-- -->" if text.isdigit() else f"\\{text}"


def markdown_fence(texts: Iterable[str], language: str = "text") -> Iterator[str]:
    """Lines of a block of code that holds ``texts`` as they are: its fence is longer than any."""
    shown = [line for text in texts for line in terminal_lines(text).split("\n")]
    longest = max((len(run) for line in shown for run in re.findall("`+", line)), default=0)
    fence = "`" * max(3, longest + 1)
    yield fence + language
    yield from shown
    yield fence


def csv_cell(text: str) -> str:
    """A cell of text in a CSV file: no formula, whatever spreadsheet opens it.

    A line feed stays, which the file's quotes hold. :func:`csv_text` reads it.
    """
    text = _seen(text, keep="\n")
    return f"'{text}" if text.lstrip().startswith(_FORMULA) or text[:1] == "\n" else text


def csv_text(cell: str) -> str:
    """The text of which :func:`csv_cell` made a cell, what cannot be seen still escaped."""
    return cell.removeprefix("'")


def latex(text: str) -> str:
    """Text in a paragraph or a cell of LaTeX, in one line; a question mark for what no font has."""
    shown = (char if char.isprintable() else "?" for char in " ".join(text.split()))
    return "".join(_LATEX.get(char, char) for char in shown).replace("--", "-{}-")


def html(text: str) -> str:
    """The text of an element or an attribute of a tree, which escapes markup when it is written."""
    return _seen(text.replace("\r\n", "\n"), keep="\n\t")


def encodable(text: str) -> str:
    """Text that UTF-8 can say, for other processes: a lone surrogate becomes its escape."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def encodable_values(values: Any) -> Any:
    """Plain values, as JSON has them, with every text in them :func:`encodable`."""
    try:
        json.dumps(values, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        return everywhere(encodable, values)
    return values  # nearly always, and many times as fast


def everywhere(escape: Callable[[str], str], value: Any) -> Any:
    """Plain values (mappings, lists, tuples) with every text in them escaped, keys as well."""
    if value is None or isinstance(value, float | int):  # most of all values, in bulk
        return value
    if isinstance(value, str):
        return escape(value)
    if isinstance(value, Mapping):
        return {everywhere(escape, k): everywhere(escape, v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(everywhere(escape, each) for each in value)
    return value


def _seen(text: str, keep: str = "") -> str:
    """Text of which everything is seen but spaces and what is in ``keep``."""
    if text.isprintable() and not _UNSEEN.search(text):
        return text
    return "".join(
        char
        if char in keep or (char.isprintable() and not _UNSEEN.match(char))
        else char.encode("unicode_escape").decode("ascii")
        for char in text
    )


def _no_command(text: str) -> str:
    return _OLD_COMMAND.sub(r"#\\x23", _COMMAND.sub(r"\1\\x3a", text))
