"""The pages of the documentation as tests read them: expanded, with their links, anchors, code."""

import functools
import re
from pathlib import Path

from reference import expand

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

#: Made by ``nox -s docs`` alone, from a run.
MADE = ("example/report.html", "example/summary.md")

_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_INDENTED = re.compile(r"(?:(?<=\n\n)|^)(?: {4}.*\n(?:\n(?= {4}))*)+", re.MULTILINE)
_INLINE = re.compile(r"`+[^`\n]+`+")
_HEADING = re.compile(r"^(#{1,6}) (.+?)(?: \{ #(\S+) \})?$", re.MULTILINE)


def pages():
    """The committed pages of the site, by their name in ``docs/``."""
    found = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
    return [name for name in found if name not in MADE]


@functools.cache
def text(name):
    """A page with its generated parts."""
    return expand((DOCS / name).read_text(encoding="utf-8"))


def blocks(markdown, language):
    """The fenced blocks of a language."""
    return [body for found, body in _FENCED.findall(markdown) if found == language]


def code(markdown):
    """All code: blocks, and what stands between backticks."""
    fenced = [body for _, body in _FENCED.findall(markdown)]
    rest = _FENCED.sub("", markdown)
    return [*fenced, *_INDENTED.findall(rest), *_INLINE.findall(_INDENTED.sub("", rest))]


def links(markdown):
    """The targets of links and pictures."""
    plain = _INLINE.sub("", _INDENTED.sub("\n", _FENCED.sub("", markdown)))
    # the text of a link may have been code
    return re.findall(r"\]\(([^)\s]+)\)", plain) + re.findall(r'src="([^"]+)"', plain)


def anchors(markdown, github=False):
    """The anchors of a page's headings, as Python-Markdown or GitHub names them."""
    found = set()
    for _, title, given in _HEADING.findall(_FENCED.sub("", markdown)):
        name = given or _slug(re.sub(r"[`*]|\]\([^)]*\)|\[", "", title), github)
        count = 0
        unique = name
        while unique in found:
            count += 1
            unique = f"{name}-{count}" if github else f"{name}_{count}"
        found.add(unique)
    return found


def _slug(title, github):
    words = re.sub(r"[^\w\s-]", "", title).strip().lower()
    return words.replace(" ", "-") if github else re.sub(r"[-\s]+", "-", words)


def section(markdown, anchor):
    """What stands below a heading, up to the next one."""
    _, _, rest = markdown.partition(f"{{ #{anchor} }}\n")
    return re.split(r"^#", rest, maxsplit=1, flags=re.MULTILINE)[0]


def section_of(markdown, title):
    """What stands below a second-level heading, up to the next one."""
    _, found, rest = markdown.partition(f"\n## {title}\n")
    assert found, f"no heading {title!r}"
    return rest.partition("\n## ")[0]


def column(markdown, head):
    """The first column of the table whose head row begins with ``head``, without backticks."""
    _, found, rest = markdown.partition(f"\n| {head} |")
    assert found, f"no table with a column {head!r}"
    rows = rest.split("\n")[2:]
    cells = []
    for row in rows:
        if not row.startswith("|"):
            break
        cells.append(row.split("|")[1].strip())
    return cells
