"""Pickles with seeded damage: what is not read is refused, with the reader's own error, and soon.

``CPAS_FUZZ=20000`` in the environment sets the number of mutations, ``CPAS_FUZZ_SEED`` the first
seed.
"""

import os
import pickle
import random
import time
import traceback
from pathlib import Path

import numpy as np
from make_pickle_fixtures import cases

from pytest_cpas.reading.pickle_loop import unpickle
from pytest_cpas.types import DataError

COUNT = int(os.environ.get("CPAS_FUZZ", "500"))
SEED = int(os.environ.get("CPAS_FUZZ_SEED", "0"))


def seeds():
    """Whole files of many versions, and each of the values alone, by each protocol."""
    folder = Path(__file__).parent / "pickles"
    whole = [path.read_bytes() for path in sorted(folder.glob("*.pkl"))]
    alone = [
        pickle.dumps({name: value}, protocol)
        for protocol in range(pickle.HIGHEST_PROTOCOL + 1)
        for name, value in cases().items()
        if name != "batches"
    ]
    return whole + alone * 2


def mutated(content, others, dice):
    """``content`` with one to four kinds of damage."""
    content = bytearray(content)
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(content))
        length = dice.choice((1, 1, 2, 4, 9, 30))
        kind = dice.randrange(7)
        if kind == 0:
            content[at] = dice.randrange(256)
        elif kind == 1:
            content[at] ^= 1 << dice.randrange(8)
        elif kind == 2 and len(content) > length:
            del content[at : at + length]
        elif kind == 3:
            content[at:at] = content[at : at + length]
        elif kind == 4:
            other = dice.choice(others)
            begin = dice.randrange(len(other))
            content[at : at + length] = other[begin : begin + length]
        elif kind == 5:
            content[at : at + 1] = bytes([dice.choice(OPCODES)])
        else:
            content[at : at + 4] = dice.choice((b"\xff" * 4, bytes(4), b"\x7f\xff\xff\xff"))
    return bytes(content)


OPCODES = b"(.01255FIJKLMNPQRSTUVX]abcdeghijlopqrstu)}BC" + bytes(range(0x80, 0x99))


def walk(value):
    """Whoever reads the values can look at all of them."""
    if isinstance(value, dict):
        for key, part in value.items():
            hash(key)
            walk(part)
    elif isinstance(value, (list, tuple, set, frozenset)):
        for part in value:
            walk(part)
    elif isinstance(value, np.ndarray):
        value.copy().tolist()
    repr(value)


def test_nothing_but_the_readers_own_error_comes_out():
    contents = seeds()
    read = 0
    for number in range(SEED, SEED + COUNT):
        dice = random.Random(number)
        content = mutated(dice.choice(contents), contents, dice)
        begin = time.process_time()
        try:
            value = unpickle(content)
        except DataError as error:
            message = str(error)
            assert "at byte " in message, number
            assert message.isprintable(), number
            assert len(message) < 600, number
        except Exception as error:
            traceback.print_exc()
            raise AssertionError(f"seed {number}: {error!r} of {content!r}") from error
        else:
            read += 1
            walk(value)
        assert time.process_time() - begin < 1, number
    assert COUNT / 50 < read < COUNT / 2, "the damage is too small, or too large"


def test_every_byte_of_a_file_may_be_cut_off():
    for content in seeds()[:41:4]:
        for length in {*range(0, len(content), 97), *range(100)}:
            try:
                unpickle(content[:length])
            except DataError:
                continue
            raise AssertionError(f"the first {length} bytes are taken for a pickle")
