"""Texts in JSON, TOML and YAML: none takes more time or memory than its reader needs, no number is
read that others could not hold, and what any kind of text says is read as it is written."""

import itertools
import json
import math
import time
from pathlib import Path

import numpy as np
import pytest

from pytest_cpas.checks.known import read_known
from pytest_cpas.protocols import ProtocolError, read_protocol
from pytest_cpas.reading.numbers import numbers
from pytest_cpas.reading.structured import (
    LARGEST_JSON,
    LARGEST_TOML,
    LARGEST_YAML,
    MOST_MARKS,
    MOST_PARTS,
    MOST_TOKENS,
    json_value,
    parse_json,
    parse_toml,
    read_toml,
    read_yaml,
)
from pytest_cpas.reading.tables import read_csv, real
from pytest_cpas.types import DataError, DeclarationError

#: Ways to write a name in TOML.
NAMES = ("a", "'&'", '"!"', '"\\u0041"', '""')
#: Where a dotted name can stand.
PLACES = ("{} = 1", "[{}]", "[[{}]]", "a = {{ {} = 1 }}", "a = 1\n[b]\nc.{} = 2")

TOML = {
    **{
        f"names {name} in {place}": (place.format(" . ".join([name] * 100)), "64 keys in one name")
        for name, place in itertools.product(NAMES, PLACES)
    },
    "lists": ("a = " + "[" * 65 + "]" * 65, "64 levels deep"),
    "tables in lists": ("a = " + "[{a=" * 40 + "1" + "}]" * 40, "64 levels deep"),
    "names in names": (f"[{'.'.join('a' * 60)}]\n{'.'.join('b' * 60)} = 1", "64 levels deep"),
    "values": ("a = [" + "1," * MOST_TOKENS + "]", "more than 200000 names, values"),
    "keys": ("\n".join(f"k{n}=1" for n in range(MOST_TOKENS // 3 + 1)), "more than 200000 names"),
    "tables": ("\n".join(f"[t{n}]" for n in range(MOST_TOKENS // 3 + 1)), "more than 200000 names"),
    "lists of tables": ("[[a]]\n" * (MOST_TOKENS // 5 + 1), "more than 200000 names"),
    "characters": ("#" * (LARGEST_TOML + 1), "at most 2097152 are read"),
    **{
        f"long {digits[:2]}": (f"a = {digits}", "at most 256 characters")
        for digits in (
            "0x" + "f" * 999,
            "0o" + "7" * 999,
            "0b" + "1" * 9999,
            "9" * 5000,
            "1_" * 999,
        )
    },
    **{
        f"of more bits {n}": (f"a = [{{b = {n}}}]", "whole number of more than 64 bits")
        for n in (2**63, -(2**63) - 1, 10**255, "0x" + "f" * 254)
    },
    "large": ("a = 1e999", "'1e999' is too large"),
    "larger": ("a = -1e9999999", "too large"),
}


def is_refused_soon(read, path, text, told):
    """In a second, with a message of one screen that says what is ``told``."""
    path.write_text(text)
    start = time.process_time()
    with pytest.raises(DataError, match=told) as raised:
        read(path)
    assert time.process_time() - start < 1
    assert len(str(raised.value)) < 600


@pytest.mark.parametrize("attack", TOML)
def test_toml(attack, tmp_path):
    text, words = TOML[attack]
    is_refused_soon(read_toml, tmp_path / "mine.toml", text, rf"mine\.toml.*{words}")


@pytest.mark.parametrize(
    "text",
    [
        'a = """x"""""\nb = \'\'\'y\'\'\'\'\'\nc = """"""',
        'a = "#"\nb = \'"\'\nc = "\\""\n"d.e" = 1 # "\nf."g h".i = 2',
        "a = [ # '\n 1, # ]\n 2 ]\nb = 1979-05-27T07:32:00Z\nc = +1_0.5e-3\nd = inf",
        f"a = {2**63 - 1}\nb = {-(2**63)}\n{'k' * 256} = 1",
        "a = '''" + "[" * 100 + "a." * 100 + "'''",
        "[[a]]\nb.c = {d = [[1], {e = 2}]}\n[[a]]\n[a.f]\r\n",
        "".join(f"k{n} = {n}\n" for n in range(MOST_TOKENS // 3)),
    ],
)
def test_toml_that_is_sound_is_read_as_by_others(text):
    import tomllib

    assert parse_toml("it", text) == tomllib.loads(text)


@pytest.mark.parametrize("text", ['a = """x', "a = '''x", 'a = "x', "a = 'x", '""" = 1', 'a = "\\'])
def test_toml_that_does_not_end_is_refused_at_once(text):
    with pytest.raises(DataError, match="it: "):
        parse_toml("it", text + "\n[[" * 2000)


LONG = ".".join("a" * 30)


@pytest.mark.parametrize(
    "text",
    [
        "a = [" + "1," * (MOST_TOKENS // 2 - 10) + "]",
        "".join(f"[t{n}]\n" for n in range(MOST_TOKENS // 3)),
        f"[{LONG}]\n" + "".join(f"k{n}.{LONG}=1\n" for n in range(350)),
        'a = "' + "\\n" * (LARGEST_TOML // 2 - 10) + '"',
    ],
    ids=["values", "tables", "names", "escapes"],
)
def test_the_largest_toml_takes_a_second(text):
    start = time.process_time()
    parse_toml("it", text)
    assert time.process_time() - start < 2  # of a machine that is slow today


JSON = {
    "lists": (b'{"a":[' + b"[]," * MOST_PARTS + b"0]}", "1000003 lists, tables and keys, at most"),
    "keys": (b'{"a":0' + b',"b":0' * MOST_PARTS + b"}", "lists, tables and keys, at most 1000000"),
    "values": (b'{"a":[' + b"1," * (2 * MOST_PARTS + 1) + b"0]}", "commas, at most 2000000"),
    "bytes": (b" " * (LARGEST_JSON + 1), f"{LARGEST_JSON + 1} bytes, at most {LARGEST_JSON}"),
    "the same key": (b'{"a": 1, "b": {"x\\u0061": 1, "xa": 2}}', "key 'xa' is there twice"),
    "large": (b'{"a": 1e999}', "'1e999' is too large"),
    "below": (b'{"a": -1e999}', "too large"),
    "digits": (b'{"a": ' + b"1" * 257 + b"}", "more than 256 digits"),
    "digits before a point": (b'{"a": ' + b"1" * 400 + b".0}", "too large"),
    "both": (b'{"a": ' + b"1" * 250 + b"e99}", "too large"),
    **{
        f"in {name}": (('{"a∀":' + "[" * 9 + "]" * 9 + ',"∀b":1}').encode(name), "not readable")
        for name in ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-32-le", "utf-32-be")
    },
}


@pytest.mark.parametrize("attack", JSON)
def test_json(attack):
    content, words = JSON[attack]
    start = time.process_time()
    with pytest.raises(DataError, match=rf"mine\.json: .*{words}") as raised:
        parse_json(Path("mine.json"), content, constants=False)
    assert time.process_time() - start < 1
    assert len(str(raised.value)) < 600


@pytest.mark.parametrize(
    "value",
    [{"a": 10**255, "b": -(10**255)}, {"a": 1.7e308, "b": 5e-324, "c": 1e-310}, {"e999": "1e999"},
     {"a": "9" * 5000, "b": 123456}, {"é": "\u2200 \U0001f600"}, {"a": [[], {}, None, True, -0.5]}],
)  # fmt: skip
def test_json_that_is_sound_is_read_as_by_others(value):
    for text in (json.dumps(value), json.dumps(value, ensure_ascii=False)):
        for mark in (b"", b"\xef\xbb\xbf"):
            assert json_value("it", mark + text.encode()) == value


def test_constants_of_json_are_read_where_they_are_written():
    value = json_value("it", b'{"a": NaN, "b": -Infinity}')
    assert math.isnan(value["a"])
    assert value["b"] == -math.inf


YAML = {
    "a text of parts": ("a: 1" + ":1" * MOST_MARKS, "at most 15000 are read"),
    "a list": ("[" + "1," * MOST_MARKS + "]", "at most 15000 are read"),
    "lines": ("- a\n" * MOST_MARKS, "at most 15000 are read"),
    "bytes": ("#" * (LARGEST_YAML + 1), "at most 262144 are read"),
    "sum of sixties": ("a: 1" + ":59" * 700, "whole number of more than 1024 bits"),
    "sum of sixties, a float": ("a: 1" + ":1" * 300 + ".0", "not readable YAML"),
    "hexadecimal": ("a: 0x" + "f" * 5000, "whole number of more than 1024 bits"),
    "binary": ("a: 0b" + "1" * 5000, "whole number of more than 1024 bits"),
    "octal": ("a: 0" + "7" * 5000, "whole number of more than 1024 bits"),
    "a key": ("? 0x" + "f" * 5000 + "\n: 1", "whole number of more than 1024 bits"),
    "digits": ("a: " + "9" * 5000, "not readable YAML"),
    "character that there is not": ('a: "\\UFFFFFFFF"', "not readable YAML"),
    "references": (
        "a0: &a0 []\n" + "".join(f"a{n}: &a{n} [{f'*a{n - 1}, ' * 9}1]\n" for n in range(1, 12)),
        "more than 1000000 values",
    ),
    "itself, twice": ("a: &a [*a, *a]", "1000000 values|64 levels"),
    "a long tag": ("a: !!" + "x" * 9000 + " b", "not readable YAML"),
    **{
        f"{tag} of {text!r}": (f"a: !!{tag} {text}", "not readable YAML")
        for tag, text in itertools.product(
            ("int", "float", "bool", "timestamp", "omap", "pairs"), ('""', '"-"', '"x"', "[1]")
        )
    },
}  # fmt: skip


@pytest.mark.parametrize("attack", YAML)
def test_yaml(attack, tmp_path):
    text, words = YAML[attack]
    is_refused_soon(read_yaml, tmp_path / "mine.yaml", text, rf"mine\.yaml: .*({words})")


# -- numbers ------------------------------------------------------------------------------------

ODD_NUMERALS = ("", " ", "1_000", " 1", "1 ", "1\n", "\t1", "\u00a05", "٣", "１２", "²", "0x10",
                "0b1", "0x1p3", "1e", "e1", ".", "+", "--1", "nan", "NaN", "Infinity", "infinity",
                "1,5", "1L", "1j", "1d5", "1e999", "9" * 401, "\ufeff1", "1\0")  # fmt: skip


@pytest.mark.parametrize("text", ODD_NUMERALS)
def test_numerals_that_are_not_plain_are_no_numbers(text):
    with pytest.raises(ValueError, match="expected a number"):
        real(text)
    with pytest.raises(DataError, match=r"x: .*expected 1 finite numbers"):
        numbers([text], (1,), "x")


@pytest.mark.parametrize(
    "value", [True, np.bool_(True), None, b"5", 1j, [1, 2], {}, 10**400, np.array([True]), "inf"]
)
def test_values_that_are_no_numbers(value):
    with pytest.raises(DataError, match=r"x: .*expected 1 finite numbers"):
        numbers([value], (1,), "x")


@pytest.mark.parametrize(
    ("text", "number"),
    [("0", 0), ("-0.0", 0), ("+1.5", 1.5), (".5", 0.5), ("5.", 5), ("1e-3", 0.001), ("1E+05", 1e5)],
)
def test_plain_numerals(text, number):
    assert real(text, -1) == number
    assert numbers([text], (1,), "x") == [number]
    assert numbers([[number]], (1,), "x") == [number]
    assert numbers(np.array([number], np.float32), (1,), "x") == [np.float32(number)]
    assert real("inf") == math.inf
    assert real("-inf", -math.inf) == -math.inf


def test_a_byte_order_mark_is_no_part_of_a_text(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"\xef\xbb\xbfa,b\n1,2\n")
    assert read_csv(path) == [{"a": "1", "b": "2"}]
    path.write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_toml(path) == {"a": 1}


# -- who reads them -----------------------------------------------------------------------------

COLUMN = '[[columns]]\nid = "c{0}"\nlabel = "l{0}"\nat = {{ rotation_deg = 1 }}\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("".join(COLUMN.format(n) for n in range(1001)), "1001 columns, at most 900"),
        (COLUMN.format(1) * 2, "two columns have the id 'c1'"),
        (COLUMN.format(1).replace('"l1"', '""'), "label is '', expected a line of text"),
        (COLUMN.format(1).replace('"l1"', '"  "'), "label is '  '"),
        (COLUMN.format(1).replace('"l1"', '"' + "x" * 10**6 + '"'), "label is 'xxx.*xxx'"),
        (COLUMN.format(1).replace("rotation_deg", "'" + "x" * 10**6 + "'"), "expected a fact"),
        ('"' + "k" * 10**6 + '" = 1', "a protocol has 'kkk.*kkk'"),
        (
            COLUMN.format(1).replace("= 1 ", "= 1e200 "),
            r"rotation_deg is 1e\+200 deg, expected 0 to",
        ),
    ],
)
def test_protocol(text, words, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('name = "p"\n' + text)
    with pytest.raises(ProtocolError, match=rf"mine\.toml: .*{words}") as raised:
        read_protocol(path)
    assert len(str(raised.value)) < 600


def test_known_failures_are_limited(tmp_path):
    path = tmp_path / "mine.known.toml"
    entry = '[[dataset]]\ncheck="c"\nreason="r"\n'
    path.write_text(entry * 10_001)
    with pytest.raises(
        DeclarationError, match=r"mine\.known\.toml: 10001 entries .* at most 10000"
    ):
        read_known(path, "dataset", ["c"])
    path.write_text(entry * 10_000)
    assert len(read_known(path, "dataset", ["c"])) == 10_000
    path.write_text(entry + f'"{"k" * 10**6}" = "x"\n')
    with pytest.raises(DeclarationError, match=r"kkk.*expected some of") as raised:
        read_known(path, "dataset", ["c"])
    assert len(str(raised.value)) < 600
