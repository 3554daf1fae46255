"""Pickles put together by hand, opcode by opcode, as ``pickletools`` names them."""

import struct

NONE, TRUE, FALSE, STOP, MARK, TUPLE, REDUCE, BUILD = (
    b"N",
    b"\x88",
    b"\x89",
    b".",
    b"(",
    b"t",
    b"R",
    b"b",
)


def proto(protocol):
    """How a pickle of this protocol begins."""
    return b"\x80" + bytes([protocol]) if protocol >= 2 else b""


def text(value):
    """BINUNICODE."""
    content = value.encode("utf-8")
    return b"X" + struct.pack("<I", len(content)) + content


def binary(value):
    """BINBYTES."""
    return b"B" + struct.pack("<I", len(value)) + value


def number(value):
    """LONG1."""
    content = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(content)]) + content


def named(module, name):
    """GLOBAL."""
    return f"c{module}\n{name}\n".encode()


def tuple_of(*parts):
    """MARK, the parts, TUPLE."""
    return MARK + b"".join(parts) + TUPLE


def called(function, *arguments):
    """REDUCE of a tuple of arguments."""
    return function + tuple_of(*arguments) + REDUCE


def dict_of(**parts):
    """A dict with these values."""
    pairs = b"".join(text(key) + part for key, part in parts.items())
    return b"}" + MARK + pairs + b"u"


CORE = "numpy.core.multiarray"
RECONSTRUCT, SCALAR = named(CORE, "_reconstruct"), named(CORE, "scalar")
NDARRAY, DTYPE = named("numpy", "ndarray"), named("numpy", "dtype")


def dtype(code, order="<", sizes=(-1, -1, 0), middle=NONE * 3):
    """A dtype as numpy writes it."""
    made = called(DTYPE, text(code), FALSE, TRUE)
    return made + tuple_of(number(3), text(order), middle, *map(number, sizes)) + BUILD


def unfilled():
    """An array before its state."""
    return called(RECONSTRUCT, NDARRAY, tuple_of(number(0)), binary(b"b"))


def array(shape, kind, content, fortran=FALSE, version=1):
    """An array as numpy writes it; ``kind`` and ``content`` are pickled."""
    lengths = tuple_of(*map(number, shape))
    return unfilled() + tuple_of(number(version), lengths, kind, fortran, content) + BUILD


def pickled(part, protocol=3):
    """The whole pickle of a dict that holds ``part``."""
    return proto(protocol) + dict_of(gt_RTs=part) + STOP
