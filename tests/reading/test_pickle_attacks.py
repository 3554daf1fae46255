"""Pickles that are made to run something, to take numpy apart, or to take all time and memory."""

import os
import pickle
import re
import struct
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from pickled import (
    BUILD,
    CORE,
    DTYPE,
    FALSE,
    MARK,
    NDARRAY,
    NONE,
    RECONSTRUCT,
    REDUCE,
    SCALAR,
    STOP,
    TRUE,
    array,
    binary,
    called,
    dict_of,
    dtype,
    named,
    number,
    pickled,
    proto,
    text,
    tuple_of,
    unfilled,
)

from pytest_cpas.reading.pickle_loop import unpickle
from pytest_cpas.types import DataError

REFUSED = "only plain values and numpy arrays are read"
NOT_OBJECTS = ("|", (-1, -1, 0))


def exploit(marker: Path) -> bytes:
    """Eight bytes that stand where os.system is, taken for it by a dtype that hides objects."""
    hidden = dtype("O", *NOT_OBJECTS)
    function = called(SCALAR, hidden, binary(struct.pack("P", id(os.system))))
    return pickled(called(function, text(f"touch {marker}")))


#: What read pickles before, in a process of its own.
BEFORE = """
import pickle, sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from test_pickle_attacks import exploit
class Restricted(pickle.Unpickler):
    def find_class(self, module, name):
        assert (module, name) in [("numpy.core.multiarray", "scalar"), ("numpy", "dtype")]
        return super().find_class(module.replace("numpy.core", "numpy._core"), name)
import io
Restricted(io.BytesIO(exploit(Path(sys.argv[1])))).load()
"""


def test_the_exploit_runs_nothing(tmp_path):
    marker = tmp_path / "ran"
    with pytest.raises(DataError, match="a dtype O has a state that no O has"):
        unpickle(exploit(marker))
    assert not marker.exists()
    folders = [str(Path(__file__).parent), *sys.path]
    subprocess.run([sys.executable, "-c", BEFORE, str(marker), *folders], check=True)
    assert marker.exists(), "the exploit of this test is a dud"


EIGHT = binary(bytes(8))
F8 = dtype("f8")
ADDRESS = binary(struct.pack("P", id(os.system)))

MADE_UP = {
    "object array over bytes": array((1,), dtype("O", "|", (-1, -1, 63)), ADDRESS),
    "object array over text": array((1,), dtype("O", "|", (-1, -1, 63)), text("x" * 8)),
    "objects hidden": array((1,), dtype("O", *NOT_OBJECTS), ADDRESS),
    "object scalar": called(SCALAR, dtype("O", "|", (-1, -1, 63)), ADDRESS),
    "objects in a buffer": called(
        named("numpy.core.numeric", "_frombuffer"),
        ADDRESS,
        dtype("O", "|", (-1, -1, 63)),
        tuple_of(number(1)),
        text("C"),
    ),
    "fields beyond the item": array(
        (1,),
        dtype(
            "V8",
            "|",
            (8, 1, 0),
            NONE + tuple_of(text("a")) + dict_of(a=tuple_of(F8, number(1 << 40))),
        ),
        EIGHT,
    ),
    "fields of a number": array(
        (1,),
        dtype("f8", middle=NONE + tuple_of(text("a")) + dict_of(a=tuple_of(F8, number(64)))),
        EIGHT,
    ),
    "shape of an item": array((1,), dtype("f8", middle=tuple_of(F8, number(9)) + NONE * 2), EIGHT),
    "item size of text": array((1,), dtype("S8", "|", (1 << 30, 1, 0)), EIGHT),
    "item size of a number": array((1,), dtype("f8", "<", (1, -1, 0)), EIGHT),
    "flags of a number": array((1,), dtype("f8", "<", (-1, -1, 63)), EIGHT),
    "metadata": array(
        (1,),
        called(DTYPE, text("f8"), FALSE, TRUE)
        + tuple_of(number(4), text("<"), NONE * 3, number(-1), number(-1), number(0), b"}")
        + BUILD,
        EIGHT,
    ),
    "two states": array((1,), F8 + tuple_of(number(3), text("<"), NONE * 3) + BUILD, EIGHT),
    "no state": array((1,), called(DTYPE, text("f8"), FALSE, TRUE), EIGHT),
    "dtype of a list": called(DTYPE, MARK + tuple_of(text("a"), text("f8")) + b"l", FALSE, TRUE),
    "dtype of a comma list": called(DTYPE, text("f8,O"), FALSE, TRUE),
    "dtype of a huge text": called(DTYPE, text("U999999999"), FALSE, TRUE),
    "dtype of other digits": called(DTYPE, text("U\u0663"), FALSE, TRUE),
    "uninitialised": called(NDARRAY, tuple_of(number(1000)), F8),
    "uninitialised, by _reconstruct": called(RECONSTRUCT, NDARRAY, tuple_of(number(9)), text("d")),
    "a code that is none": called(RECONSTRUCT, NDARRAY, tuple_of(number(0)), NONE),
    "an array as a code": called(
        RECONSTRUCT, NDARRAY, tuple_of(number(0)), array((2,), F8, binary(bytes(16)))
    ),
    "never filled": unfilled(),
    "class that is none": called(RECONSTRUCT, DTYPE, tuple_of(number(0)), text("b")),
    "filled twice": array((1,), F8, EIGHT)[:-1] + BUILD + tuple_of(NONE) + BUILD,
    "too few bytes": array((2,), F8, EIGHT),
    "too many bytes": array((), F8, EIGHT * 2)[:-1],
    "negative length": array((-1, -1), F8, EIGHT),
    "length that overflows": array((1 << 63, 2), F8, EIGHT),
    "length of text": unfilled() + tuple_of(number(1), text("1"), F8, FALSE, EIGHT) + BUILD,
    "33 dimensions": array((1,) * 33, F8, EIGHT),
    "65 dimensions": array((1,) * 65, F8, EIGHT),
    "nothing in a huge shape": array((0, 1 << 26, 1 << 26), F8, binary(b"")),
    "items of no size": array((1 << 26,), dtype("S0", "|", (0, 1, 0)), binary(b"")),
    "truth of 2": array((8,), dtype("b1", "|"), binary(b"\2" * 8)),
    "no characters": array((1,), dtype("U2", "<", (8, 4, 8)), binary(b"\xff" * 8)),
    "surrogates": array((1,), dtype("U1", "<", (4, 4, 8)), binary(b"\x00\xd8\0\0")),
    "scalar of no characters": called(SCALAR, dtype("U1", "<", (4, 4, 8)), binary(b"\xff" * 4)),
    "axes that are none": called(
        named("numpy._core.numeric", "_frombuffer"),
        EIGHT,
        F8,
        tuple_of(number(1)),
        text("K"),
        tuple_of(number(7)),
    ),
    "defaults of a function": named("numpy._core.numeric", "_frombuffer")
    + tuple_of(NONE, dict_of(__defaults__=tuple_of(number(1))))
    + BUILD,
    "attributes of a class": NDARRAY + tuple_of(NONE, dict_of(__setstate__=NONE)) + BUILD,
    "state of a dict": b"}" + dict_of(a=NONE) + BUILD,
    "state of a list": b"]" + NONE + BUILD,
    "a name as a value": NDARRAY,
    "a dtype as a value": F8,
    "a name as a key": b"}" + NDARRAY + NONE + b"s",
    "an array as a key": b"}" + array((1,), F8, EIGHT) + NONE + b"s",
    "an array called": array((1,), F8, EIGHT) + b")" + REDUCE,
    "a text called": text("os.system") + b")" + REDUCE,
    "encoding that is none": called(named("_codecs", "encode"), text("a"), text("rot13")),
    "encoding of no name": called(named("_codecs", "encode"), text("a")),
    "bytes of a number": called(named("builtins", "bytes"), number(1 << 40)),
    "bytearray of a number": called(named("builtins", "bytearray"), number(1 << 40)),
    "set of text": called(named("builtins", "set"), text("abc")),
    "set of lists": called(named("builtins", "set"), b"]" + b"]" + b"a"),
    "complex of text": called(named("builtins", "complex"), text("1")),
    "a list that holds itself": b"]" + b"q\x07h\x07a",
    "a dict that holds itself": b"}" + b"q\x07" + text("a") + b"h\x07s",
    "a memo that is empty": b"h\x09",
    "a memo that is empty, by text": b"g-1\n",
    "an opcode that is none": b"\xff",
    "bytes of negative length": b"T\xff\xff\xff\xff",
    "bytes of endless length": b"\x8e" + b"\xff" * 8,
    "frame of endless length": b"\x95" + b"\xff" * 8,
    "a mark too few": b"t",
    "a key without a value": b"}" + MARK + text("a") + b"u",
    "half a pair": b"V\\ud800\n",
    "not UTF-8": b"X\x01\0\0\0\xff",
    "an escape that is none": b"S'\\q'\n",
    "a quote too few": b"S'a\n",
    "underscores in a number": b"I1_0\n",
    "a number in words": b"Fnanosecond\n",
    "an array as a length": unfilled()
    + tuple_of(number(1), array((2,), F8, binary(bytes(16))), F8, FALSE, EIGHT)
    + BUILD,
    "an array as an order": unfilled()
    + tuple_of(number(1), tuple_of(number(1)), F8, array((2,), F8, binary(bytes(16))), EIGHT)
    + BUILD,
    "an array as a version": unfilled()
    + tuple_of(array((2,), F8, binary(bytes(16))), tuple_of(number(1)), F8, FALSE, EIGHT)
    + BUILD,
}


@pytest.mark.parametrize("name", MADE_UP)
def test_what_nobody_writes_is_refused(name):
    for protocol in range(6):
        with pytest.raises(DataError, match=r"at byte \d+, ") as caught:
            unpickle(pickled(MADE_UP[name], protocol))
        message = str(caught.value)
        assert message.isprintable()
        assert len(message) < 500


def test_the_same_parts_well_put_together_are_read():
    """So that the refusals above are for what they say."""
    read = unpickle(
        pickled(
            MARK
            + array((1,), F8, EIGHT)
            + array((2,), dtype("O", "|", (-1, -1, 63)), b"]" + NONE + b"a" + TRUE + b"a")
            + array((1,), dtype("S8", "|", (8, 1, 0)), EIGHT)
            + array((1,), dtype("U2", "<", (8, 4, 8)), EIGHT)
            + array((8,), dtype("b1", "|"), EIGHT)
            + array((0, 1 << 10, 1 << 10), F8, binary(b""))
            + array((1,) * 32, F8, EIGHT)
            + called(SCALAR, F8, EIGHT)
            + called(named("_codecs", "encode"), text("\xff"), text("latin1"))
            + b"l"
        )
    )["gt_RTs"]
    assert [part.shape for part in read[:5]] == [(1,), (2,), (1,), (1,), (8,)]
    assert [read[1].tolist(), read[-2], read[-1]] == [[None, True], 0.0, b"\xff"]


NAMES = [
    ("os", "system"),
    ("posix", "system"),
    ("nt", "system"),
    ("subprocess", "Popen"),
    ("builtins", "eval"),
    ("builtins", "exec"),
    ("builtins", "getattr"),
    ("builtins", "__import__"),
    ("builtins", "print"),
    ("builtins", "map"),
    ("__builtin__", "eval"),
    ("__builtin__", "file"),
    ("importlib", "import_module"),
    ("functools", "partial"),
    ("functools", "reduce"),
    ("operator", "methodcaller"),
    ("types", "FunctionType"),
    ("pickle", "loads"),
    ("_pickle", "Unpickler"),
    ("ctypes", "CDLL"),
    ("sys", "exit"),
    ("webbrowser", "open"),
    ("copy_reg", "_reconstructor"),
    ("copyreg", "__newobj__"),
    ("codecs", "decode"),
    ("_codecs", "decode"),
    ("numpy", "load"),
    ("numpy", "fromfile"),
    ("numpy", "memmap"),
    ("numpy", "recarray"),
    ("numpy", "dtype.__class__"),
    ("numpy.core", "multiarray.fromfile"),
    (CORE, "fromfile"),
    (CORE, "_reconstruct.__self__"),
    (CORE, "array"),
    ("numpy.core.records", "fromfile"),
    ("numpy.lib.npyio", "NpzFile"),
    ("numpy.random._pickle", "__randomstate_ctor"),
    ("numpy.ma.core", "_mareconstruct"),
    ("numpy.testing._private.utils", "runstring"),
    ("numpy.distutils.exec_command", "exec_command"),
    ("numpy.f2py", "compile"),
    ("numpy.ctypeslib", "load_library"),
    ("torch", "load"),
    ("torch._utils", "_rebuild_tensor_v2"),
    ("torch.storage", "_load_from_bytes"),
    ("joblib.numpy_pickle", "NumpyArrayWrapper"),
    ("pandas.io.pickle", "read_pickle"),
    ("pytest_cpas.reading.pickles", "load_numpy_pickle"),
    ("", ""),
    ("os.path", "join\x1b[31m"),
    ("os", "системa"),
]


def routes(module, name, command):
    """How the opcodes can come by a name and have it called, each with a harmless command."""
    argument = text(command)
    given = f"c{module}\n{name}\n".encode()
    stacked = text(module) + text(name) + b"\x93"
    return {
        "GLOBAL": given,
        "STACK_GLOBAL": stacked,
        "STACK_GLOBAL, short": b"".join(
            b"\x8c" + bytes([len(part.encode())]) + part.encode() for part in (module, name)
        )
        + b"\x93",
        "REDUCE": called(given, argument),
        "REDUCE, STACK_GLOBAL": called(stacked, argument),
        "INST": MARK + argument + f"i{module}\n{name}\n".encode(),
        "OBJ": MARK + given + argument + b"o",
        "NEWOBJ": given + tuple_of(argument) + b"\x81",
        "NEWOBJ_EX": given + tuple_of(argument) + b"}\x92",
        "BUILD": given + tuple_of(NONE, dict_of(__setstate__=argument)) + BUILD,
        "dtype": called(DTYPE, given, FALSE, TRUE),
        "_reconstruct": called(RECONSTRUCT, given, tuple_of(number(0)), text("b")),
        "array": array((1,), given, EIGHT),
        "object array": array((1,), dtype("O", "|", (-1, -1, 63)), b"]" + given + b"a"),
        "key": b"}" + given + NONE + b"s",
        "popped": given + b"0" + NONE,
        "EXT1": b"\x82\x01",
        "EXT2": b"\x83\x01\x00",
        "EXT4": b"\x84\x01\x00\x00\x00",
        "PERSID": f"P{module} {name}\n".encode(),
        "BINPERSID": tuple_of(text(module), text(name)) + b"Q",
        "NEXT_BUFFER": b"\x97",
        "READONLY_BUFFER": NONE + b"\x98",
    }


@pytest.mark.parametrize(("module", "name"), NAMES)
def test_no_name_is_called_by_any_opcode(module, name, tmp_path, capfd):
    before = set(sys.modules)
    marker = tmp_path / "ran"
    for route, part in routes(module, name, f"touch {marker}").items():
        for protocol in range(6):
            with pytest.raises(DataError) as caught:
                unpickle(pickled(part, protocol))
            message = str(caught.value)
            assert message.isprintable(), route
            assert REFUSED in message, route
            assert re.match(r"at byte \d+, the pickle ", message), route
    assert not marker.exists()
    assert capfd.readouterr() == ("", "")
    assert set(sys.modules) == before, "something was imported"


def test_classes_that_arrays_need_are_made_by_no_other_opcode():
    for known in (NDARRAY, DTYPE, RECONSTRUCT, named("builtins", "bytearray")):
        for part in (known + b")\x81", known + b")}\x92", MARK + known + b"o"):
            with pytest.raises(DataError, match=REFUSED):
                unpickle(pickled(part))
    with pytest.raises(DataError, match=REFUSED):
        unpickle(pickled(MARK + b"inumpy\nndarray\n"))


def large_keys():
    """Tuples whose hash is the same: of numbers that are -1 or -2, which hash alike."""
    pairs = (
        tuple_of(*(number(-1 - (n >> bit & 1)) for bit in range(16))) + NONE for n in range(1 << 16)
    )
    return b"}" + MARK + b"".join(pairs) + b"u"


LARGE = binary(b"\0" * (1 << 20)) + b"q\x01"

BOMBS = {
    "lists doubled": b"]q\x00" + b"0(h\x00h\x00lq\x00" * 40,
    "tuples doubled": b")q\x00" + b"0h\x00h\x00\x86q\x00" * 40,
    "dicts doubled": b"}q\x00" + b"0}(K\x01h\x00K\x02h\x00uq\x00" * 40,
    "object arrays doubled": NONE
    + b"q\x00"
    + (b"0" + array((2,), dtype("O", "|", (-1, -1, 63)), b"]" + MARK + b"h\x00h\x00e") + b"q\x00")
    * 40,
    "lists in lists": b"]" * 100_000 + b"a" * 99_999,
    "tuples in tuples": b")" + b"\x85" * 1_000_000,
    "dicts in dicts": b"}" + b"K\x01}" * 50_000 + b"s" * 50_000,
    "marks": MARK * 1_000_000,
    "a tuple of tuples as a key": b")q\x00" + b"h\x00h\x00\x86q\x00" * 1000 + b"}h\x00Ns",
    "a long tuple as a key a thousand times": MARK
    + NONE * 100_000
    + b"tq\x000}"
    + b"h\x00Ns" * 1000,
    "long text as a key": b"X"
    + struct.pack("<I", 1 << 22)
    + b"x" * (1 << 22)
    + b"q\x000}"
    + b"h\x00Ns" * 100_000,
    "numbers that collide": b"}"
    + MARK
    + b"".join(number(n * ((1 << 61) - 1)) + NONE for n in range(100_000))
    + b"u",
    "tuples that collide": large_keys(),
    "sets again and again": MARK
    + b"".join(number(n) for n in range(20_000))
    + b"lq\x00"
    + (named("builtins", "set") + b"h\x00\x85R0") * 10_000,
    "byte arrays again and again": LARGE
    + (b"0" + named("builtins", "bytearray") + b"h\x01\x85R") * 10_000,
    "texts encoded again and again": text("x" * (1 << 20))
    + b"q\x01"
    + (b"0" + called(named("_codecs", "encode"), b"h\x01", text("latin1"))) * 10_000,
    "truths looked at again and again": LARGE
    + dtype("b1", "|")
    + b"q\x02"
    + (b"0" + array((1 << 20,), b"h\x02", b"h\x01")) * 10_000,
    "text scalars again and again": LARGE
    + dtype(f"S{1 << 20}", "|", (1 << 20, 1, 0))
    + b"q\x02"
    + (b"0" + called(SCALAR, b"h\x02", b"h\x01")) * 10_000,
    "an array again and again": LARGE
    + array((1 << 20,), dtype("u1", "|"), b"h\x01")
    + b"q\x03"
    + b"0"
    + MARK
    + b"h\x03" * 10_000
    + b"l",
    "object arrays again and again": MARK
    + NONE * 100_000
    + b"lq\x01"
    + dtype("O", "|", (-1, -1, 63))
    + b"q\x02"
    + (b"0" + array((100_000,), b"h\x02", b"h\x01")) * 10_000,
    "a memo without end": NONE + b"\x94" * 5_000_000,
    "places in the memo": NONE
    + b"".join(b"r" + struct.pack("<I", n << 12) for n in range(1 << 20))
    + b"\xff",
    "the largest place in the memo": NONE + b"r\xff\xff\xff\xff" + b"\xff",
    "opcodes without end": NONE + b"N0" * 3_000_001,
    "sets without end": MARK + b"\x8f" * 3_000_000 + b"l",
    "dicts without end": MARK + b"}" * 3_000_000 + b"l",
    "tuples without end": MARK + b"N\x85" * 3_100_000 + b"l",
    "pairs without end": MARK + b"N\x85" * 2_900_000 + b"l",
    "lists without end": MARK + b"]" * 6_000_001 + b"l",
    "a long integer": b"\x8b" + struct.pack("<I", 1 << 20) + b"\x7f" * (1 << 20),
    "a long integer, in decimals": b"L" + b"9" * 1_000_000 + b"L\n",
    "a long number": b"F" + b"9" * 1_000_000 + b"\n",
    "a line without end": b"I" + b"0" * 10_000_000,
    "a name without end": b"c" + b"x" * 10_000_000,
    "backslashes": b"S'" + b"\\" * 10_000_001 + b"'\n",
    "escapes": b"S'" + b"\\n" * 5_000_000 + b"\n",
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_end_soon(name):
    content = pickled(BOMBS[name])
    begin = time.process_time()
    with pytest.raises(DataError) as caught:
        unpickle(content)
    assert time.process_time() - begin < 5
    assert len(str(caught.value)) < 500


MEMORY = """
import re, resource, sys
sys.path[:0] = sys.argv[1:]
from test_pickle_attacks import BOMBS
from pickled import pickled
from pytest_cpas.reading.pickle_loop import unpickle
from pytest_cpas.types import DataError
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in [name for name in BOMBS if re.search("again and|without end|memo", name)]:
    part = BOMBS[name]
    try:
        unpickle(pickled(part))
    except DataError:
        pass
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert after - before < 2**20, f"{name}: {after - before} KiB"
print("all", after - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts memory as Linux does")
def test_bombs_take_less_than_a_gibibyte():
    command = [sys.executable, "-c", MEMORY, str(Path(__file__).parent), *sys.path]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("all")


def test_what_a_real_file_may_have_is_within_the_limits():
    content = {
        "frames": {(n // 500, n): n for n in range(3000)},
        "ids": dict.fromkeys(range(20_000)),
        "words": {f"scene_{n}": n for n in range(200_000)},
        "numbers": np.random.default_rng(0).normal(size=(100_000, 3)).tolist(),
        "masks": np.zeros((480, 640, 50), bool),
    }
    for protocol in (2, 4):
        read = unpickle(pickle.dumps(content, protocol))
        assert read.pop("masks").shape == (480, 640, 50)
        assert read == {key: value for key, value in content.items() if key != "masks"}


def test_a_protocol_of_the_future_is_named():
    with pytest.raises(DataError, match="protocol 6, at most 5 is read"):
        unpickle(proto(6) + NONE + STOP)
