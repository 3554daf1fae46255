"""Bytes from a worker that is none, or lies: each is refused in a sentence, and nothing is run."""

import json
import os
import pickle
import select

import numpy as np
import pytest

from pytest_cpas.remote.answers import info_of, predictions_of
from pytest_cpas.remote.frames import FrameError, encoded
from pytest_cpas.remote.process import _Reading
from pytest_cpas.remote.worker import LARGEST_BODY, LARGEST_HEADER, LENGTHS
from pytest_cpas.types import AnswerError, DeclarationError

TOKEN = b"0123456789abcdef"


def read(content: bytes, *, pieces: int = 1) -> _Reading:
    """What comes of bytes that arrive in so many pieces."""
    reading = _Reading(TOKEN, bytearray())
    there, here = os.pipe()
    size = min(-(-len(content) // pieces), 2**15)
    try:
        for start in range(0, len(content), size):
            os.write(here, content[start : start + size])
            while not reading.whole and select.select([there], [], [], 0)[0]:
                reading.read_from(there)
        return reading
    finally:
        os.close(there)
        os.close(here)


def frame(header: object, body: bytes = b"") -> bytes:
    text = json.dumps(header).encode()
    return TOKEN + LENGTHS.pack(len(text), len(body)) + text + body + TOKEN


@pytest.mark.parametrize("pieces", [1, 2, 7, 1000])
@pytest.mark.parametrize("noise", [b"", b"Welcome to host\n", TOKEN[:8]])
def test_answer_is_read_however_it_arrives(pieces, noise):
    arrays = [np.arange(6, dtype="<f4").reshape(2, 3), np.zeros((0, 3)), np.array(2.0)]
    content = b"".join(map(bytes, encoded(TOKEN, {"value": 1}, arrays)))
    reading = read(noise + content + b"rest", pieces=pieces)
    assert reading.whole
    assert reading.header["value"] == 1
    assert all(np.array_equal(a, b) for a, b in zip(reading.arrays, arrays, strict=True))
    assert b"rest".startswith(bytes(reading.rest))
    assert not any(array.flags.writeable for array in reading.arrays)


FRAMES = {
    "a pickle": (TOKEN + LENGTHS.pack(40, 0) + pickle.dumps("x" * 40)[:40] + TOKEN, "not readable"),
    "text": (frame("hello"), "an answer whose header is 'hello'"),
    "no arrays": (frame({}), "an answer whose header is {}"),
    "long header": (TOKEN + LENGTHS.pack(LARGEST_HEADER + 1, 0), "header takes 4194305 bytes, at"),
    "long body": (TOKEN + LENGTHS.pack(2, LARGEST_BODY + 1), "arrays takes 268435457 bytes, at"),
    "objects": (frame({"arrays": [["|O", [1]]]}, bytes(8)), r"an array that is \['\|O', \[1\]\]"),
    "other order": (frame({"arrays": [[">f8", [1]]]}, bytes(8)), "an array that is"),
    "no type": (frame({"arrays": [[["<f8"], [1]]]}, bytes(8)), "an array that is"),
    "no list": (frame({"arrays": ["<f8"]}), "an array that is '<f8'"),
    "negative": (frame({"arrays": [["<f8", [-1]]]}), "an array that is"),
    "a truth value": (frame({"arrays": [["|u1", [True]]]}, b"1"), "an array that is"),
    "axes": (frame({"arrays": [["<f8", [1] * 9]]}, bytes(8)), "an array that is"),
    "beyond": (frame({"arrays": [["<f8", [2**62]]]}, bytes(8)), "take more than its 8 bytes"),
    "too little": (frame({"arrays": [["<f8", [1]]]}, bytes(9)), "take 8 of its 9 bytes"),
    "many": (frame({"arrays": [["<f8", [0]]] * 10_001}), "an answer of 10001 arrays, at most"),
    "cut in": (
        frame({"arrays": [["<f8", [1]]]}, bytes(8)).replace(bytes(8), b"noise" + bytes(8)),
        "an answer that does not end where it says",
    ),
    "noise": (b"y\n" * 2**20, "somebody else has written into its pipe, and no answer came"),
}


@pytest.mark.parametrize(("content", "sentence"), FRAMES.values(), ids=list(FRAMES))
def test_other_bytes_are_refused(content, sentence):
    with pytest.raises(FrameError, match=sentence):
        read(content)


@pytest.mark.parametrize(
    ("told", "sentence"),
    [
        ("x", "'x', expected a list of answers"),
        ([1], "1, expected hypotheses"),
        ([{"hypotheses": [{"rotation": 5}]}], "expected the places of arrays"),
        ([{"hypotheses": [{"rotation": True}]}], "expected the places of arrays"),
        ([{"hypotheses": [{"rotation": 0, "translation": 1, "colour": 0}]}], "colour"),
        ([{"hypotheses": [], "reason": 5}], "reason is a int"),
        ([{"hypotheses": []}], "no hypothesis and no reason"),
    ],
)
def test_answers_of_another_kind_are_refused(told, sentence):
    with pytest.raises(AnswerError, match=sentence):
        predictions_of(told, [np.eye(3), np.zeros(3)])


GOOD = {
    "name": "good",
    "categories": ["mug"],
    "needs": ["depth"],
    "gives": ["extents"],
    "licence": "MIT",
}


ASSET = {"path": "w.pt", "url": "https://example.org", "licence": "MIT"}


def test_what_is_declared():
    info = info_of({**GOOD, "assets": [ASSET], "camera_frame": "opengl"}, "good", "good-3.6")
    assert (info.name, info.camera_frame, info.assets[0].path) == ("good-3.6", "opengl", "w.pt")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        (
            {"gives_mesh": True},
            "info has 'gives_mesh', expected some of assets, batch, camera_frame,",
        ),
        ({"name": "../good"}, "a name becomes a folder"),
        ({"categories": "mug"}, "info's categories is 'mug', expected a list"),
        ({"categories": []}, "declares no categories"),
        ({"needs": [1]}, "expected names"),
        ({"gives": ["colour"]}, "gives has .'colour'"),
        ({"assets": [{"path": "w"}]}, "an asset is {'path': 'w'}, expected a dictionary of path"),
        ({"assets": [dict(ASSET, path="../../etc/passwd")]}, "expected a file below the weights"),
        ({"assets": [dict(ASSET, path="/etc/passwd")]}, "asset '/etc/passwd': expected a file bel"),
        ({"assets": [dict(ASSET, path=".")]}, "asset '.': expected a file below the weights fold"),
        ({"licence": None}, "info's licence is None, expected a text, such as 'MIT'"),
        ({"name": None}, "info's name is None, expected a text"),
        ({"deterministic": "no"}, "info's deterministic is 'no', expected True or False"),
        ({"tolerance": "1"}, "info's tolerance is '1', expected a number"),
        ({"batch": "many"}, "info's batch is 'many'"),
        ({"batch": 0}, "batch is 0, expected how many observations"),
        ({"camera_frame": "blender"}, "camera_frame is 'blender', expected one of"),
    ],
)
def test_declarations_of_another_kind_are_refused(changes, sentence):
    with pytest.raises(DeclarationError, match=sentence):
        info_of({**GOOD, **changes}, "good")


@pytest.mark.parametrize("part", GOOD)
def test_declaration_that_lacks_something(part):
    lacking = {name: value for name, value in GOOD.items() if name != part}
    with pytest.raises(DeclarationError, match=part if part != "categories" else "no categories"):
        info_of(lacking, "good")
