"""Write tests/reading/pickles: the same values as pickled by many versions of Python and numpy.

Run it with each interpreter (from Python 2.7 on) and numpy (from 1.13 on) that can be had::

    python2.7 tools/make_pickle_fixtures.py tests/reading/pickles

Each protocol of the interpreter gives one file, named by its own checksum, so that versions that
write the same bytes share it; ``writers.txt`` says who wrote which.
"""

import hashlib
import os
import pickle
import platform
import sys

import numpy as np


def cases():
    """The values by name: what numpy arrays and plain values there are, in small."""
    small = np.arange(6).reshape(2, 3)
    text = b"M\xc3\xbcller".decode("utf-8")
    words = np.array([[text[:2], "bc"], ["", "d"]])
    objects = np.empty((2, 2), dtype=object)
    objects[0, 0], objects[0, 1], objects[1, 0] = None, [1.5, "x"], small.astype("i2")
    shared = np.array([0.25, -0.5])
    locked = np.array([1, 2], dtype="i4")
    locked.setflags(write=False)
    found = {"array " + code: small.astype(code) for code in NUMBERS}
    found.update({"scalar " + code: np.array([-2.5, 3]).astype(code)[1] for code in NUMBERS})
    found.update(
        {
            "not finite": np.array([np.nan, np.inf, -np.inf, -0.0]),
            "text array": words,
            "text array, big-endian": words.astype(">U2"),
            "text scalar": words[0, 0],
            "empty text scalar": words[1, 0],
            "bytes array": np.array([b"a", b"\xffbc"]),
            "bytes scalar": np.array([b"\xfea"])[0],
            "Fortran order": np.asfortranarray(small.astype("f4")),
            "strided": np.arange(12.0).reshape(2, 6)[:, ::2],
            "reversed": np.arange(3)[::-1],
            "transposed": np.transpose(np.arange(24, dtype="u1").reshape(2, 3, 4), (1, 0, 2)),
            "broadcast": np.broadcast_to(np.array([1, 2], dtype="i2"), (3, 2)),
            "no dimensions": np.array(2.5),
            "empty": np.empty((0,), dtype="i4"),
            "empty poses": np.empty((0, 4, 4)),
            "empty masks": np.empty((4, 5, 0), dtype=bool),
            "read-only": locked,
            "objects": objects,
            "objects, Fortran order": np.asfortranarray(objects),
            "no objects": np.empty((0, 3), dtype=object),
            "twice": [shared, {"again": shared}],
            "nothing": None,
            "truths": [True, False],
            "integers": [0, -1, 255, 256, 65536, -(2**31), 2**31, 2**63, -(2**63)],
            "reals": [0.0, -0.0, 1.5, -1e300, float("inf"), float("nan")],
            "complex": 1.5 - 2j,
            "ascii": "a 'quoted' \"text\" \\ and \n\t\r",
            "text": text,
            "other planes": b"\xf0\x9f\x98\x80 \xe2\x82\xac".decode("utf-8"),
            "no text": "",
            "bytes": [b"", b"ab", b"\x00\xff\n'"],
            "byte arrays": [bytearray(), bytearray(b"\x00\xff")],
            "tuples": [(), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)],
            "sets": [set(), {1, 2}, frozenset(), frozenset(["a"])],
            "keys": {0: 0, 2.5: 1, None: 2, True: 3, (4, "x"): 4, np.int64(7): 5},
            "nested": {"a": [{"b": ({"c": [[]]}, {})}]},
            "batches": [None] * 1001,
        }
    )
    return found


#: Codes of numbers, and a few that are big-endian.
NUMBERS = ("b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8", "c8", "c16")
NUMBERS += (">i2", ">u4", ">f4", ">f8", ">c16")


def main(folder):
    """Add what this interpreter and this numpy write."""
    writers = os.path.join(folder, "writers.txt")
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        content = pickle.dumps(cases(), protocol)
        name = hashlib.sha256(content).hexdigest()[:12] + ".pkl"
        with open(os.path.join(folder, name), "wb") as file:
            file.write(content)
        seen = [name, "protocol", str(protocol), "Python", platform.python_version()]
        seen += ["numpy", np.__version__]
        with open(writers, "a") as file:
            file.write(" ".join(seen) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
