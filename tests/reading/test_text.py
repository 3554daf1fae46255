"""Each destination of text from outside, with whatever text there is."""

import csv
import io
import json
import math
import re

import pytest
from hostile import ALL, KINDS, harmless_csv, harmless_in_a_terminal, harmless_markdown
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_cpas.reading import text as reading
from pytest_cpas.reading.text import (
    WIDTH,
    csv_cell,
    csv_text,
    encodable,
    encodable_values,
    everywhere,
    folded,
    html,
    latex,
    markdown,
    markdown_fence,
    say,
    terminal_line,
    terminal_lines,
)

#: Any characters, with those between them that mean something somewhere.
TEXTS = st.lists(
    st.sampled_from([*KINDS.values(), *":#[]|`<>@=+-'\\\t\n\r ", "://", "www.", "##", "::"])
    | st.text(max_size=4)
    | st.characters(categories=["Cc", "Cf", "Cs", "Zl", "Zp"]),
    max_size=12,
).map("".join)

EVERY = settings(max_examples=400, deadline=None, database=None)


@pytest.mark.parametrize("text", [*KINDS.values(), ALL])
def test_each_kind_is_harmless_in_a_terminal(text):
    line, lines = terminal_line(text), terminal_lines(text)
    assert "\n" not in line
    assert "\t" not in line
    harmless_in_a_terminal(line)
    harmless_in_a_terminal(lines)


@EVERY
@given(TEXTS)
def test_terminal(text):
    for shown in (terminal_line(text), terminal_lines(text)):
        harmless_in_a_terminal(shown)
        assert shown in (terminal_line(shown), terminal_lines(shown))
    assert "\n" not in terminal_line(text)


@EVERY
@given(TEXTS)
def test_markdown(text):
    harmless_markdown(markdown(text))
    assert "\n" not in markdown(text)
    cells = f"| {markdown(text)} | x |"
    assert len(re.findall(r"(?<!\\)(?:\\\\)*\|", cells)) == 3
    first, *inside, last = markdown_fence([text])
    assert first == last + "text"
    assert all(last not in line for line in inside)
    harmless_in_a_terminal("\n".join(inside))


@EVERY
@given(TEXTS)
def test_csv(text):
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows([["text"], [csv_cell(text)]])
    harmless_csv(file.getvalue())
    _, (cell,) = csv.reader(io.StringIO(file.getvalue(), newline=""))
    if text.replace("\n", "").isprintable() and csv_text(cell) != text:
        assert reading._UNSEEN.search(text)
    assert csv_text(csv_cell(csv_text(cell))) == csv_text(cell)


@EVERY
@given(TEXTS)
def test_html_latex_and_other_processes(text):
    assert html(text).replace("\n", "").replace("\t", "").isprintable()
    encodable(text).encode()
    shown = latex(text)
    assert shown.isprintable()
    # every command is one of ours, every brace has its other one
    assert not re.search(
        r"\\(?!text(backslash|asciitilde|asciicircum|less|greater|bar)\{\}|char34|[&%$#_{}])", shown
    )
    bare = re.sub(r"\\[{}]", "", shown)
    assert bare.count("{") == bare.count("}")


def test_what_is_harmless_stays_as_it_is():
    plain = "scene_1/0005 (mug): 3.5 °, a::b, é, 中 and #5 ← [x]"
    assert terminal_line(plain) == terminal_lines(plain) == html(plain) == csv_cell(plain) == plain
    assert encodable(plain) == plain
    assert terminal_lines("a\n\tb\r\nc") == "a\n\tb\nc"
    assert terminal_line("\x1b\n\ud800\u202e") == "\\x1b\\n\\ud800\\u202e"
    assert markdown("real275 at 10 deg, 2 cm") == "real275 at 10 deg, 2 cm"


@pytest.mark.parametrize("text", ["plain", "gr\u00f6\u00dfer", "\ud800 alone", "\U0001f600"])
def test_encodable_values(text):
    values = {text: [text, (text, 1.5, None, True, math.inf)]}
    found = encodable_values(values)
    assert found == everywhere(encodable, values)
    json.dumps(found, ensure_ascii=False).encode()
    assert (found is values) == ("\ud800" not in text)


def test_everywhere():
    value = {"a\n": ["b\n", ("c\n", 1, None)]}
    assert everywhere(terminal_line, value) == {"a\\n": ["b\\n", ("c\\n", 1, None)]}


def test_many_line_ends_take_no_time():
    assert terminal_lines("\n" * 200_000 + ":: " * 10).endswith("\n\\x3a: " + ":: " * 9)


def test_say(capsys):
    say("a\x1b", "::b", 3)
    assert capsys.readouterr().out == "a\\x1b\n\\x3a:b\n3\n"


def test_folded_lines_hold_the_same_words_and_fit():
    """Whatever stands on a line; what has no spaces stays whole."""
    text = (
        "REGRESSED mug: "
        + "lost: a (1 cm) ; " * 200
        + "\n  note: "
        + "word " * 50
        + "\n\nshort  line"
    )
    lines = folded(text).split("\n")
    assert max(map(len, lines)) <= WIDTH
    assert " ".join(lines).split() == text.split()
    assert lines[-2:] == ["", "short  line"]
    assert all(line.startswith("    ") for line in lines[1 : lines.index(lines[0], 0) + 2])
    noted = lines.index(next(line for line in lines if line.startswith("  note")))
    assert lines[noted + 1].startswith("      word")
    assert folded("x" * 500) == "x" * 500
    # what a line goes on with is no command, once it is escaped
    assert "\n    ::" not in terminal_lines(folded("a" * 98 + " ::error::"))
