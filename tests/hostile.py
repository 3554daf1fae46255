"""Text as strangers write it, and what must not come of it, whichever way it went."""

import csv
import io
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

#: One of each kind of what text can do to whoever shows it.
KINDS = {
    "escape": "\x1b[31mred\x1b]0;title\x07",
    "line": "a\n::error file=x::b\r\n  ::warning::c\r##[error]d",
    "command": "::error::x",
    "old commands": "##[group]x ##vso[task.setvariable]y ##teamcity[z]",
    "direction": "\u202eevil\u2066\u200f",
    "no width": "a\u200bb\ufeffc\u2060d\u3164e\ufe0ff\u00ad",
    "lines of other kinds": "a\u2028b\x85c\x0bd\x0ce",
    "surrogate": "\ud800x",
    "zero": "\x00",
    "formula": "=cmd|' /C calc'!A0",
    "plus": "+1", "minus": "-1+1", "at": "@SUM(1)", "tab": "\t=1", "space": " =1",
    "apostrophe": "'=1",
    "markdown": "|`*_[x](http://x.y)![z](www.x.y)~~#1 @me\n# h\n- l\n```\n</details>",
    "html": "<script>alert(1)</script><img src=x onerror=alert(2)>\"'&amp;",
    "tex": "\\input{/etc/passwd}%&$#_{}~^--[x]*",
    "data": "]]>&x;<!--",
}  # fmt: skip

ALL = " ".join(KINDS.values())

#: Those of which ids and categories may consist: what is not printable is refused there.
IN_NAMES = {kind: text for kind, text in KINDS.items() if text.isprintable()}


def harmless_in_a_terminal(text: str) -> None:
    """Neither a terminal nor a CI service takes anything in it for a command."""
    for line in text.split("\n"):
        strange = [char for char in line.replace("\t", " ") if not char.isprintable()]
        assert not strange, (strange, line)
        assert "\u3164" not in line
        assert "\ufe0f" not in line
        assert not line.lstrip().startswith("::"), line
        assert not re.search(r"##\w*\[", line), line


def harmless_markdown(text: str) -> None:
    """What is not in a block of code neither marks up nor names anything; tables are whole."""
    for line in text.split("\n"):
        assert line.replace("\t", "").isprintable(), line
    outside = re.sub(r"(?ms)^(`{3,})\w+\n.*?^\1$", "", text)
    for line in outside.split("\n"):
        plain = re.sub(r"<(/?(details|summary)|br|!-- --)>", "", line)
        assert not re.search(r"<\w|<!|(?<!\\)`|(?<![\\!])\[", plain), line
        assert not re.search(r"[@]\w|://\w|www\.", line), line
    for block in re.findall(r"(?m)(?:^\|.*\n)+", outside):
        columns = {len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(columns) == 1, block


def harmless_csv(text: str) -> None:
    """No cell is a formula but for numbers; each line has as many cells as there are columns."""
    head, *lines = csv.reader(io.StringIO(text, newline=""))
    for line in lines:
        assert len(line) == len(head)
        for cell in line:
            assert not re.match(r"[=@\t\r＝＋－＠]|[+-](?![\d.]+$)", cell.lstrip()), cell
            assert cell.replace("\n", "").isprintable(), cell


def harmless_html(text: str, others: str) -> None:
    """It has the elements of a page with other text, and no character that is not seen."""
    assert text.replace("\n", "").replace("\t", "").isprintable()
    assert _elements(text) == _elements(others)


def _elements(text: str) -> list[tuple[str, list[str]]]:
    """Every tag with the names of its attributes."""
    found = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag, attributes):
            found.append((tag, [name for name, _ in attributes]))

    Reader().feed(text)
    return found


def harmless_xml(text: bytes) -> None:
    """It can be parsed, and shows nothing that a terminal must not."""
    for element in ElementTree.fromstring(text).iter():
        for part in (*element.attrib.values(), element.text or ""):
            harmless_in_a_terminal(part)
