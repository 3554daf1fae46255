"""Every reader against damaged files: seeded mutations of sound ones, in processes of their own.

    python tests/reading/fuzzing.py 20000 [SEED]        # so many over all readers
    python tests/reading/fuzzing.py --atheris 60        # seconds for each, guided by coverage

Nothing but the reader's own error may come out, within a second and a gibibyte. A case that breaks
this is printed with what makes it again: the name of the reader and the number of the case.
"""

from __future__ import annotations

import faulthandler
import hashlib
import io
import json
import os
import random
import re
import resource
import struct
import subprocess
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))  # when this is run as a script
sys.path.insert(0, str(Path(__file__).parents[1] / "submissions"))

import forms
from older_tables import older_texts

from pytest_cpas.types import Camera, ContractError

SECONDS = 1.0
MEMORY = 2**30

Mutate = Callable[[bytes, random.Random], bytes]


@dataclass(frozen=True)
class Reader:
    """``run`` reads a file; ``seeds`` are sound contents; ``errors`` its own kinds of error."""

    run: Callable[[Path], object]
    seeds: Callable[[], Sequence[bytes]]
    suffix: str = ".bin"
    errors: tuple[type[Exception], ...] = (ContractError,)
    mutations: Sequence[Mutate] = field(default=())
    #: Public functions of `reading` that a run goes through, as ``module.function``.
    covers: Sequence[str] = ()


# -- mutations ----------------------------------------------------------------------------------

EDGES = (
    b"\xff" * 4,
    bytes(4),
    b"\x7f\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\x80\0\0\0",
    b"\1\0\0\0",
)


def damaged(content: bytes, dice: random.Random) -> bytes:
    """One to four kinds of damage that know nothing of the format."""
    data = bytearray(content)
    for _ in range(dice.randint(1, 4)):
        if not data:
            data += bytes(dice.randrange(256) for _ in range(4))
        at, length = dice.randrange(len(data)), dice.choice((1, 2, 4, 9, 60, 500))
        kind = dice.randrange(8)
        if kind == 0:
            data[at] ^= 1 << dice.randrange(8)
        elif kind == 1:
            data[at] = dice.randrange(256)
        elif kind == 2:
            del data[at : at + length]
        elif kind == 3:
            data[at:at] = data[at : at + length] * dice.choice((1, 3, 50))
        elif kind == 4:
            other = dice.randrange(len(data))
            data[at : at + length] = data[other : other + length]
        elif kind == 5:
            data[at : at + 4] = dice.choice(EDGES)
        elif kind == 6:
            del data[at:]
        else:
            data[at:at] = bytes(dice.randrange(256) for _ in range(length))
    return bytes(data)


WORDS = (
    b"NaN", b"nan", b"Infinity", b"-inf", b"1e999", b"-1", b"0", b"1" * 5000, b"1e308", b"1.5",
    b"null", b"true", b'""', b"[]", b"{}", b'"x"', b"[" * 2000, b'{"a":' * 2000, b"9" * 20, b"-0",
    b"1_000", b"0x10", b"\xff", b"\0", b'"' + b"x" * 300 + b'"', b"a." * 300 + b"a=1", b"\\",
    b"'",
    b"- " * 500, b"&a [*a, *a]", b"1e-400", b"1/0", b"\xe2\x80\xae", b"\r", b"\n" * 50,
    b", " * 2000,
)  # fmt: skip

TOKEN = re.compile(rb"-?\d[\d.eE+-]*|\"[^\"\n]*\"|true|false|null|[\w]+")


def tokens(content: bytes, dice: random.Random) -> bytes:
    """A token of a text, or a few, become something else of the kind that texts hold."""
    for _ in range(dice.randint(1, 3)):
        found = list(TOKEN.finditer(content))
        if not found:
            return content + dice.choice(WORDS)
        match = dice.choice(found)
        content = content[: match.start()] + dice.choice(WORDS) + content[match.end() :]
    return content


LEAVES = (
    *(None, True, False, 0, -1, 0.5, 2, 10**15, 10**400, 1e308, -1e308, 1e999, -1e999),
    *("", "all", "x", "1" * 99, [], {}, [None], {"a": 1}, [[]] * 9999),
)


def leaf(content: bytes, dice: random.Random) -> bytes:
    """Another value at a place of a JSON text, at any level; it stays JSON, but for infinity."""
    try:
        value = json.loads(content)
    except (ValueError, RecursionError):  # damaged before
        return content
    place, key = None, None
    here = value
    while isinstance(here, dict | list) and here and (place is None or dice.random() < 0.85):
        place, key = here, dice.choice(list(here) if isinstance(here, dict) else range(len(here)))
        here = here[key]
    if place is not None:
        place[key] = dice.choice(LEAVES)
    return json.dumps(value).replace("Infinity", "1e999").encode()


def lines(content: bytes, dice: random.Random) -> bytes:
    """Lines are left out, exchanged, or there twice."""
    parts = content.split(b"\n")
    for _ in range(dice.randint(1, 3)):
        at, other = dice.randrange(len(parts)), dice.randrange(len(parts))
        dice.choice((parts.insert, parts.__setitem__))(at, parts[other])
    return b"\n".join(parts)


def zip_fields(content: bytes, dice: random.Random) -> bytes:
    """A field of a header of an archive: method, flags, size, length of a name, offset."""
    data = bytearray(content)
    heads = [m.start() for m in re.finditer(rb"PK(?:\x01\x02|\x03\x04|\x05\x06)", content)]
    for _ in range(dice.randint(1, 2) if heads else 0):
        at = dice.choice(heads) + dice.randrange(4, 44, 2)
        width = dice.choice((2, 4))
        data[at : at + width] = dice.choice((*EDGES, b"\x0c\0\0\0", b"\x09\0\0\0"))[:width]
    return bytes(data)


def rezipped(content: bytes, dice: random.Random) -> bytes:
    """The arrays of an ``.npz`` damaged, under right checksums, or called otherwise."""
    target = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as source, zipfile.ZipFile(target, "w") as made:
            for info in source.infolist():
                array = source.read(info)
                if dice.random() < 0.3:
                    array = dice.choice((damaged, npy_header))(array, dice)
                name = dice.choice((info.filename,) * 20 + ("x/" + info.filename, "a" * 300))
                method = dice.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA))
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of a name that is there twice
                    made.writestr(name, array, method)
    except Exception:
        return content
    return target.getvalue()


HEADERS = (
    "<f8", "<f2", "<f4", "<f16", ">f8", "<i8", "|i1", "<u8", "|b1", "|O", "<U3", "|S5", "<c16",
    "<M8[s]", "<U0", "<V8", "=f8", "<f3", "<U999999999",
)  # fmt: skip
SHAPES = (
    "()", "(0,)", "(3,)", "(2, 3)", "(-1,)", "(9999999999,)", "(1e3,)", "(3L,)", "(True,)",
    "(0, 9999999999999)", "((3,),)", "(" * 500, "(__import__('os').system('exit 3'),)",
)  # fmt: skip


def npy_header(content: bytes, dice: random.Random) -> bytes:
    """Another header before the values of a ``.npy``."""
    header = (
        f"{{'descr': {dice.choice(HEADERS)!r}, 'fortran_order': {dice.choice((True, False))},"
        f" 'shape': {dice.choice(SHAPES)}, }}\n"
    )
    body = content[128:] * dice.choice((0, 1, 1, 1, 5))
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header.encode() + body


def png_chunks(content: bytes, dice: random.Random) -> bytes:
    """A chunk damaged under its right checksum, or one of another length."""
    chunks, at = [], 8
    while at + 8 <= len(content):
        (length,) = struct.unpack(">I", content[at : at + 4])
        chunks.append((content[at + 4 : at + 8], content[at + 8 : at + 8 + length]))
        at += 12 + length
    made = content[:8]
    chosen = dice.randrange(len(chunks)) if chunks else -1
    for index, (kind, body) in enumerate(chunks):
        length = len(body)
        if index == chosen:
            body = damaged(body, dice) if body else bytes(9)
            length = dice.choice((len(body), len(body), 0xFFFFFFFF, 2**31 - 1, 0))
            kind = dice.choice((kind, kind, b"zTXt", b"iCCP", b"tRNS", b"PLTE", b"acTL"))
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        made += struct.pack(">I", length) + kind + body + checksum
    return made


def checksummed(content: bytes, dice: random.Random) -> bytes:
    """The lines of a results file damaged, under right checksums."""
    from pytest_cpas.evaluation.results import checksum_of

    made, last = b"", b""
    for line in content.split(b"\n")[:-1]:
        text = line.partition(b" ")[2]
        if dice.random() < 0.3:
            text = dice.choice((tokens, damaged))(text, dice).replace(b"\n", b"")
        last = checksum_of(last, text)
        made += last + b" " + text + b"\n"
    return made


def matching(content: bytes, dice: random.Random) -> bytes:
    """A golden table whose ``table.toml`` names the digest of its damaged ``samples.csv``."""
    toml, _, samples = content.partition(SEPARATOR)
    samples = dice.choice((tokens, lines, damaged))(samples, dice)
    digest = hashlib.sha256(samples).hexdigest().encode()
    toml = re.sub(rb'(samples_sha256 = )"\w*"', rb'\1"' + digest + b'"', toml)
    return toml + SEPARATOR + samples


SEPARATOR = b"\n# ---- samples.csv\n"

# -- readers ------------------------------------------------------------------------------------

TEXT = (tokens, tokens, lines)
ARCHIVE = (zip_fields, rezipped, rezipped)


def saved(save: Callable[[Any], object]) -> bytes:
    made = io.BytesIO()
    save(made)
    return made.getvalue()


def images(mode: str) -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        shape = (24, 32, 3) if mode == "RGB" else (24, 32)
        kind = np.uint16 if mode == "I;16" else np.uint8
        picture = Image.fromarray(np.arange(np.prod(shape)).reshape(shape).astype(kind))
        return [saved(lambda file, form=form: picture.save(file, form)) for form in FORMS[mode]]

    return seeds


FORMS = {"RGB": ("PNG", "JPEG"), "I;16": ("PNG",), "L": ("PNG",)}
CAMERA = Camera(32, 24, 30, 30, 16, 12)


def meshes(kind: str) -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        import trimesh

        box = trimesh.creation.box()
        found = [box.export(file_type=kind)]
        if kind == "ply":
            found.append(box.export(file_type=kind, encoding="ascii"))
            found.append(quads_in_ply())
        if kind == "stl":
            found.append(trimesh.exchange.stl.export_stl_ascii(box))
        return [each.encode() if isinstance(each, str) else each for each in found]

    return seeds


def quads_in_ply() -> bytes:
    """In bytes, with a triangle and a quadrilateral, so that rows are read one by one."""
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y"
        "\nproperty float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = (3, 0, 1, 2), (4, 0, 1, 2, 3)
    faces = b"".join(struct.pack(f"<B{row[0]}i", *row) for row in rows)
    return head.encode() + np.eye(4, 3).astype("<f4").tobytes() + faces


def archives() -> list[bytes]:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a/b.txt", "hello" * 100)
        archive.writestr("c.bin", bytes(300))
    found = [packed.getvalue()]
    for mode in ("w", "w:gz", "w:xz", "w:bz2"):
        tar = io.BytesIO()
        with tarfile.open(fileobj=tar, mode=mode) as made:
            for name in ("a/b.txt", "x" * 150 + "/é"):
                info = tarfile.TarInfo(name)
                info.size = 500
                made.addfile(info, io.BytesIO(bytes(500)))
        found.append(tar.getvalue())
    return found


def unpacked(path: Path) -> None:
    from pytest_cpas.reading.archives import unpack

    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        unpack(path, Path(folder) / "to")
        assert {p.name for p in Path(folder).iterdir()} == {"to"}


def tensors() -> list[bytes]:
    import torch

    content = {"a.weight": torch.ones(3, 4), "b": {"c": torch.zeros(5, dtype=torch.int64)}}
    return [
        saved(lambda file, new=new: torch.save(content, file, _use_new_zipfile_serialization=new))
        for new in (True, False)
    ]


def arrays() -> list[bytes]:
    values = {"a": np.eye(3), "names": np.array(["x", "yy"]), "ids": np.arange(5)}
    return [
        saved(lambda f: np.savez(f, **values)),
        saved(lambda f: np.savez_compressed(f, **values)),
    ]


def predictions() -> list[bytes]:
    pose = np.diag([0.2, 0.2, 0.2, 1.0])
    side = {
        "class_ids": np.array([2, 6]),
        "bboxes": np.array([[0, 0, 10, 10], [0, 20, 10, 30.0]]),
        "RTs": np.stack([pose, pose]),
        "scales": np.ones((2, 3)),
        "offset": np.array([0, 1, 2]),
    }
    both = {f"{name}_{key}": array for name in ("gt", "pred") for key, array in side.items()}
    return [saved(lambda file: np.savez(file, frame=np.array(["scene_1_0000", "b"]), **both))]


def judged(path: Path) -> None:
    from pytest_cpas.evaluation import SampleError, StoredRun

    run = StoredRun(path)
    for ref in run.samples:
        try:
            row = run.judge(ref)
            assert (
                row.failure
                or np.isfinite([row.facts["position_m"], row.facts["rotation_deg"]]).all()
            )
        except SampleError:
            pass


def forms_with_truth() -> list[bytes]:
    """A list of frames, and a DetectMatch as an object of its class."""
    import pickle

    made = forms.frames(("scene_1/0000", "scene_1/0001"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "x.pkl")
        listed = forms.listed(path, made).read_bytes()
        match = pickle.dumps(pickle.loads(forms.cutoop(path, made).read_bytes()), 3)
    return [listed, b"\x80\x03ccutoop.eval_utils\nDetectMatch\n)\x81" + match[2:-1] + b"b."]


def forms_without_truth(kind: str) -> list[bytes]:
    made = forms.frames(("scene_1/0000", "scene_1/0001"))
    if kind == "catre":
        with tempfile.TemporaryDirectory() as folder:
            return [forms.catre(Path(folder, "x.pkl"), made).read_bytes()]
    pose = np.diag([1.0, 1, 1, 1])
    if kind == "bop":
        with tempfile.TemporaryDirectory() as folder:
            rows = [((1, 2, number), 0.5, pose) for number in (1, 7)]
            return [forms.bop(Path(folder, "x.csv"), rows).read_bytes()]
    return [saved(lambda file: np.savetxt(file, pose))]


def detections() -> list[bytes]:
    """What a detector found in an image."""
    import pickle

    masks = np.zeros((6, 8, 2), bool)
    masks[1:3, 1:3] = True
    found = {
        "rois": np.array([[1, 1, 3, 3]] * 2, np.int32), "class_ids": np.array([2, 6]),
        "scores": np.array([0.9, 0.8], np.float32), "masks": masks,
    }  # fmt: skip
    return [pickle.dumps(found, 2)]


def detected(path: Path) -> None:
    """What a detector found, in a folder of its own."""
    import tiny

    from pytest_cpas.submissions import DetectedDataset

    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "results_test_scene_0_0000.pkl").symlink_to(path.absolute())
        DetectedDataset(tiny.Tiny(None), Path(folder))


def json_lines() -> list[bytes]:
    """Our own form: with points, a mesh and a failure, and of detections."""
    from pytest_cpas.submissions import Given, Header, answer_line
    from pytest_cpas.types import Hypothesis, Mesh, Prediction

    whole = {
        "rotation": np.eye(3), "translation": np.full(3, 0.1), "extents": np.ones(3), "score": 0.5,
    }  # fmt: skip
    mesh = Mesh(np.eye(3), np.array([[0, 1, 2]]))
    shaped = [Hypothesis(**whole, points=np.eye(3) / 3), Hypothesis(**whole, mesh=mesh)]
    gives = frozenset({"extents", "score", "shape"})
    header = Header(object_frame="nocs", gives=gives, classes=["mug"], method="m", samples=2)
    beside = Given("mug", Prediction(shaped[1:]), np.ones(4))
    lines = [
        header.line(),
        answer_line("a", "1", Given("mug", Prediction(shaped), None), gives, [beside] * 2),
        answer_line("a", "2", Given("", Prediction.failed("none"), np.ones(4)), gives),
    ]
    bare = Header(object_frame="shapenet", gives=frozenset(), classes=["mug", "can"])
    found = Prediction([Hypothesis(rotation=np.eye(3), translation=np.ones(3))])
    line = answer_line("b", None, Given("can", found, np.ones(4)), bare.gives)
    detected = [bare.line(), line, line]
    return ["\n".join(each).encode() for each in (lines, detected)]


def leaf_of_line(content: bytes, dice: random.Random) -> bytes:
    """A leaf of one of several lines."""
    lines = content.split(b"\n")
    number = dice.randrange(len(lines))
    lines[number] = leaf(lines[number], dice)
    return b"\n".join(lines)


def answered(path: Path) -> None:
    """Answers that are read beside a data set; a matrix lies in a folder of its own."""
    from types import SimpleNamespace

    from pytest_cpas.submissions import failures, order, read_submission
    from pytest_cpas.types import SampleRef

    names = [f"obj_{number:06d}" for number in range(1, 8)]
    known = dict.fromkeys(names, np.ones(3)) if path.suffix == ".csv" else {}
    samples = [SampleRef(id="s", category="obj_000001", scene="")]
    dataset = SimpleNamespace(
        name="x", class_names=names, published_axes=None, published_centres=known,
        samples=samples, image_of=lambda ref: "a",
    )  # fmt: skip
    if path.suffix == ".txt":
        with tempfile.TemporaryDirectory() as folder:
            copy = Path(folder, "0001.txt")
            copy.symlink_to(path.absolute())  # which may be a pipe
            try:
                read = read_submission(copy.parent, dataset)
            except ContractError as error:
                raise type(error)(str(error).replace(f"{copy}", f"{path}")) from None
    else:
        read = read_submission(path, dataset)
    for image in read.images:
        assert len(order(image.answers)) == len(failures(image.answers)) == len(image.answers)
        assert len(list(image.answers.shapes or ())) in (0, len(image.answers))


def results() -> list[bytes]:
    from pytest_cpas.evaluation.results import checksum_of
    from pytest_cpas.facts import fact

    facts = {"position_m": 0.01, "rotation_deg": 3.5, "iou": 0.9, "fscore_1cm": None, "nad": None}
    header = {
        "header": {
            "method": "m", "dataset": "d", "shard": "1/1", "selected": 2, "listed": {"mug": 2},
            "missing": [], "derived": "", "damaged": [], "identity": {"data": "x"},
            "definitions": {name: fact(name).definition for name in facts},
            "provenance": {"code": "y"}, "files": {"a.py": "z"}, "seeds": 1,
            "under_contract": True, "nonce": "00",
        },
        "format": FORMAT,
    }  # fmt: skip
    answer = {"facts": facts, "failure": None, "estimate": None}
    row = {"answers": [answer], "shape": None}
    none = facts | {
        "position_m": float("inf"), "rotation_deg": float("inf"), "iou": float("-inf"),
    }  # fmt: skip
    failed = {
        "answers": [{"facts": none, "failure": "not detected", "estimate": None}],
        "shape": None,
    }
    contract = {
        "check": "c", "outcome": "passed", "demanded": True, "message": "", "known": False,
        "recorded": False,
    }  # fmt: skip
    values = [
        header,
        {"contract": contract},
        {"row": row, "ref": ["a/0", "mug", "a", ""]},
        {"error": "it raised", "ref": ["a/1", "mug", "a", ""]},
        {"program": {"code": "z"}, "files": {"a.py": "w"}},
        {"row": failed, "ref": ["a/1", "mug", "a", ""]},
    ]
    made, last = b"", b""
    for value in values:
        text = json.dumps(value, separators=(",", ":")).encode()
        last = checksum_of(last, text)
        made += last + b" " + text + b"\n"
    return [made]


FORMAT = 9


def merged(path: Path) -> None:
    from pytest_cpas.evaluation import SampleError, merge
    from pytest_cpas.golden import RunTable
    from pytest_cpas.golden.texts import table_texts

    for run in merge([path], allow_gaps=True):
        rows = []
        for ref in run.samples:
            try:
                rows.append(run.judge(ref))
            except SampleError:
                continue
        table_texts(RunTable.of(run, rows))


def a_table() -> Any:
    """A golden table of four samples under three seeds."""
    from types import SimpleNamespace

    from pytest_cpas.evaluation import Answer, Row
    from pytest_cpas.facts import fact
    from pytest_cpas.golden import RunTable
    from pytest_cpas.protocols import shipped_protocol

    names = ("position_m", "rotation_deg", "iou", "fscore_1cm", "nad")
    rows = [
        Row(
            sample=f"a/{index}", category="mug",
            answers=tuple(
                Answer(facts={
                    "position_m": 0.01 * index, "rotation_deg": 3.0 * index + seed, "iou": 0.5,
                    "fscore_1cm": None, "nad": None,
                })
                for seed in range(3)
            ),
        )
        for index in range(4)
    ]  # fmt: skip
    run: Any = SimpleNamespace(
        method="m", dataset="d", identity={"data": "x"}, provenance={"code": "y"},
        definitions={name: fact(name).definition for name in names},
        protocols=(shipped_protocol("cpas"),), samples=[], listed={"mug": 4}, seeds=3,
    )  # fmt: skip
    return RunTable.of(run, rows)


def a_report() -> bytes:
    """A report of the run of that table."""
    from types import SimpleNamespace

    from pytest_cpas.report.document import document, run_document

    table = a_table()
    run: Any = SimpleNamespace(
        method="m", dataset="d", missing=[], derived="", damaged=[], notes=["a note"], seeds=3,
        identity=table.identity,
        definitions=table.definitions, provenance=table.provenance, listed=table.listed,
        samples=[],
    )  # fmt: skip
    made = document([run_document(run, table, golden=table)], 0, table.protocols)
    return json.dumps(made).encode()


def reported(path: Path) -> None:
    """A report that is read, written anew, and judged under another protocol."""
    from pytest_cpas.protocols import shipped_protocol
    from pytest_cpas.report.files import write_report
    from pytest_cpas.report.rejudged import rejudged
    from pytest_cpas.report.stored import read_report

    document = read_report(path)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        for content in (document, rejudged(document, [shipped_protocol("omni6dpose")])):
            write_report(content, Path(folder), {})


def older_goldens() -> list[bytes]:
    texts = older_texts(a_table())
    return [texts["table.toml"].encode() + SEPARATOR + texts["samples.csv"].encode()]


def goldens() -> list[bytes]:
    from pytest_cpas.golden.texts import table_texts

    texts = table_texts(a_table())
    return [SEPARATOR.join(texts[name].encode() for name in GOLDEN_FILES)]


def points() -> list[bytes]:
    """Two points of a robustness profile, one of which states other conditions than the other."""
    from pytest_cpas.golden.points import Points

    table = replace(a_table(), dataset="d+unperturbed")
    kept = Points({}, {}, {}).joined("unperturbed", table)
    (protocol,) = table.protocols
    other = replace(
        table, dataset="d+light-2", protocols=(replace(protocol, version=2),), provenance={"a": "b"}
    )
    texts = kept.joined("light-2", other).texts()
    return [SEPARATOR.join(texts[name].encode() for name in GOLDEN_FILES)]


GOLDEN_FILES = ("run.toml", "facts.csv", "cpas.toml")


def golden(path: Path, folder_name: str = "d") -> None:
    from pytest_cpas.golden.files import read_tables

    parts = path.read_bytes().split(SEPARATOR)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        place = Path(folder) / "recorded" / "m" / folder_name
        place.mkdir(parents=True)
        for name, part in zip(GOLDEN_FILES, parts, strict=False):
            (place / name).write_bytes(part)
        read_tables(place)


def golden_points(path: Path) -> None:
    golden(path, "d+robustness")


def older_golden(path: Path) -> None:
    from pytest_cpas.golden.files import read_golden

    toml, _, samples = path.read_bytes().partition(SEPARATOR)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        place = Path(folder) / "recorded" / "m" / "d"
        place.mkdir(parents=True)
        (place / "table.toml").write_bytes(toml)
        (place / "samples.csv").write_bytes(samples)
        read_golden(place)


def number_text(path: Path) -> None:
    """A text of numbers in all the ways in which they are asked for."""
    from pytest_cpas.reading.files import decoded
    from pytest_cpas.reading.numbers import numbers, quaternion_rotation, whole
    from pytest_cpas.reading.paths import below, natural
    from pytest_cpas.reading.structured import json_value
    from pytest_cpas.types import DataError

    text = decoded(path, path.read_bytes(), "replace")
    sorted([natural(text), natural("a1"), natural("1")])
    whole(text)
    with suppress(DataError):
        assert ".." not in below(path, text, "it").parts
    value = json_value("it", text.encode())
    assert np.isfinite(numbers(value, (4,), "it")).all()
    quaternion_rotation(value, "it")


def table_text(path: Path) -> None:
    from pytest_cpas.reading.tables import read_csv, real

    for record in read_csv(path):
        for text in record.values():
            try:
                assert np.isfinite(real(text, most=1e9))
            except ValueError:
                continue


def whole_file(path: Path) -> None:
    from pytest_cpas.reading.files import read_bytes, read_text, sha256
    from pytest_cpas.reading.paths import names

    assert sha256(path) == hashlib.sha256(read_bytes(path)).hexdigest()
    assert path.name in names(path.parent)
    read_text(path)


def of(module: str, function: str, *arguments: object) -> Callable[[Path], object]:
    """Calls a reader of a module, which is imported when it is first needed."""

    def run(path: Path) -> object:
        import importlib

        return getattr(importlib.import_module(module), function)(path, *arguments)

    return run


TRACE_HEAD = {
    "format": "pytest-cpas trace 1", "method": "m", "dataset": "d", "sample": "s/0",
    "category": "mug", "seed": 0, "most": 1000, "identity": {"data": "x"}, "provenance": {},
    "spread_of": {"batch": "0"}, "values": 5, "reason": None,
}  # fmt: skip
TRACE_VALUES = {
    "0000": ("observation.depth", "observation", [4, 5], 1),
    "0001": ("network.x", "tap", [3, 7], 2),
    "0002": ("picked", "draw", [6], 1),
    "0003": ("answer.rotation", "answer", [3, 3], 1),
    "0004": ("answer.translation", "answer", [3], 1),
}
PARITY_MAP = (
    b'replay = ["picked"]\n[[values]]\nreference = "a.b"\nhere = "c"\ntake = [0, 2]\naxis = 1\n'
    b'transpose = [1, 0]\nreshape = [6]\nquaternion = "scalar-first"\n'
)


def trace_arrays() -> dict[str, Any]:
    shapes = {name: shape for name, (_, _, shape, _) in TRACE_VALUES.items()} | {"0001": [11]}
    return {name: np.ones(shape, np.float32) for name, shape in shapes.items()} | {
        "0003": np.eye(3)
    }


def trace_lines() -> list[bytes]:
    from pytest_cpas.traces.values import digest_of

    arrays = trace_arrays()
    lines = [TRACE_HEAD]
    for array, (name, kind, shape, stride) in TRACE_VALUES.items():
        lines.append(
            {"name": name, "call": 1, "kind": kind, "stage": "network", "shape": shape,
             "stride": stride, "digest": digest_of(arrays[array]), "norm": 1.0, "spread": 0.5,
             "array": array}
        )  # fmt: skip
    return ["".join(json.dumps(line) + "\n" for line in lines).encode()]


def traced(path: Path) -> None:
    """A damaged trace beside sound arrays, compared with itself and with what has no values."""
    from pytest_cpas.traces.comparing import compare
    from pytest_cpas.traces.files import read_sample
    from pytest_cpas.traces.recording import Trace

    if os.path.lexists(path):
        np.savez(path.with_suffix(".npz"), **trace_arrays())
    trace = read_sample(path).trace
    other = Trace(values=[value.replaced(digest="other") for value in trace.values])
    for each in (trace, other, Trace(values=[])):
        compare(trace, each)


def own_errors() -> tuple[type[Exception], ...]:
    from pytest_cpas.evaluation import ResultsError
    from pytest_cpas.golden import GoldenError
    from pytest_cpas.reading.archives import ArchiveError
    from pytest_cpas.report.stored import StoredReportError
    from pytest_cpas.timing.records import RecordError

    return ContractError, ResultsError, GoldenError, ArchiveError, StoredReportError, RecordError


R = "pytest_cpas.reading."
JSON = b'{"a": [1, 2.5, -3e4], "b": {"c": "text \\u00e9", "d": [null, true]}, "e": [[1], [2]]}'
TOML = b"format = 1\n[a]\nb = \"x\"\nc = [1, 2.5, [3]]\n[[d]]\ncheck = \"e\"\nreason = '''\nf'''\n"
YAML = b"a: [1, 2.5]\nb:\n  - {c: d}\n  - e: 2020-01-01\nf: &x text\ng: *x\n"
CSV = b'id,category,value\na/0,mug,1.5\n"b,1",can,2\nc,"x\ny",3e-4\n'
KNOWN = (
    b'[[metric]]\ncheck = "c"\noutcome = "raised"\nreason = "r"\ncase = \'{"a": [1]}\'\n'
    b'snippet = "s"\n'
)
SPEED = (
    b'format = 1\n[spread]\nlower = 0.9\nupper = 1.1\nconfidence = 0.99\n[identity]\n"data" = "x"\n'
    b'[provenance]\n"cpu" = "y"\n[ratios]\n"a/0" = 1.5\n'
)

#: What reads the formats of meshes.
MESHES = (
    "mesh_texts.obj_mesh", "mesh_texts.off_mesh", "mesh_texts.polygon_triangles",
    "mesh_binary.ply_mesh", "mesh_binary.stl_mesh", "mesh_rows.lines_of", "mesh_rows.corners",
    "mesh_rows.fans", "mesh_rows.shown",
)  # fmt: skip

READERS: dict[str, Reader] = {
    "bytes": Reader(
        whole_file, lambda: [JSON], covers=("files.read_bytes", "files.read_text", "files.sha256",
                                            "files.opened", "files.regular", "paths.names",
                                            "paths.matching"),
    ),
    "json": Reader(of(R + "structured", "read_json"), lambda: [JSON], mutations=TEXT,
                   covers=("structured.read_json", "structured.parse_json")),
    "toml": Reader(of(R + "structured", "read_toml"), lambda: [TOML], mutations=TEXT,
                   covers=("structured.read_toml", "structured.parse_toml", "files.decoded")),
    "yaml": Reader(of(R + "structured", "read_yaml"), lambda: [YAML], mutations=TEXT,
                   covers=("structured.read_yaml",)),
    "csv": Reader(table_text, lambda: [CSV], mutations=TEXT,
                  covers=("tables.read_csv", "tables.csv_table", "tables.csv_lines",
                          "tables.by_column", "tables.real", "files.lines_of")),
    "numbers": Reader(number_text, lambda: [b"[0, 0, 0, 1]", b'[[0.6], ["0.8"], 0, -0]', b'"3"'],
                      mutations=TEXT,
                      covers=("words.decimal", "numbers.numbers", "numbers.whole",
                              "numbers.quaternion_rotation",
                              "paths.natural", "paths.below", "structured.json_value")),
    "npy": Reader(of(R + "arrays", "read_npy"), lambda: [saved(lambda f: np.save(f, np.eye(3)))],
                  mutations=(npy_header,), covers=("arrays.read_npy",)),
    "npz": Reader(of(R + "arrays", "read_npz"), arrays, mutations=ARCHIVE,
                  covers=("arrays.read_npz",)),
    "rgb": Reader(of(R + "images", "read_rgb", CAMERA), images("RGB"), mutations=(png_chunks,),
                  covers=("images.read_rgb", "png.png_parts", "png.check_rows")),
    "depth": Reader(of(R + "images", "read_depth", CAMERA), images("I;16"), ".png",
                    mutations=(png_chunks,), covers=("images.read_depth",)),
    "ids": Reader(of(R + "images", "read_ids", CAMERA), images("L"), mutations=(png_chunks,),
                  covers=("images.read_ids",)),
    "image size": Reader(of(R + "images", "image_size"), images("RGB"), mutations=(png_chunks,),
                         covers=("images.image_size",)),
    **{
        kind: Reader(of(R + "meshes", "read_mesh"), meshes(kind), f".{kind}",
                     mutations=TEXT, covers=("meshes.read_mesh", *MESHES))
        for kind in ("obj", "off", "ply", "stl")
    },
    "archive": Reader(unpacked, archives, mutations=(zip_fields,),
                      covers=("archives.unpack", "zips.open_zip", "tars.tar_members",
                              "compressed.decompressed")),
    "tensors": Reader(of(R + "checkpoints", "read_tensors"), tensors, mutations=(zip_fields,),
                      covers=("checkpoints.read_tensors", "pickle_walk.walk")),
    "pickle": Reader(of(R + "pickles", "load_numpy_pickle"),
                     lambda: [__import__("pickle").dumps({"a": np.eye(3), "b": [1, "x"]}, protocol)
                              for protocol in range(6)],
                     covers=("pickles.load_numpy_pickle", "pickle_loop.unpickle",
                             "pickle_loop.carried_out",
                             "pickle_limits.check_values")),
    "predictions": Reader(judged, predictions, ".npz", mutations=ARCHIVE),
    "forms": Reader(judged, forms_with_truth, ".pkl",
                    covers=("pickles.load_pickle", "pickle_opcodes.build")),
    **{
        kind: Reader(answered, lambda kind=kind: forms_without_truth(kind), suffix,
                     mutations=() if kind == "catre" else TEXT)
        for kind, suffix in (("catre", ".pkl"), ("bop", ".csv"), ("matrices", ".txt"))
    },
    "detections": Reader(detected, detections, ".pkl"),
    "json lines": Reader(answered, json_lines, ".jsonl",
                         mutations=(leaf_of_line, leaf_of_line, *TEXT)),
    "results": Reader(merged, results, ".jsonl", mutations=(checksummed,) * 4),
    "golden": Reader(golden, goldens),
    "golden points": Reader(golden_points, points),
    "older golden": Reader(older_golden, older_goldens, mutations=(matching,) * 4),
    "known": Reader(of("pytest_cpas.checks.known", "read_known", "metric", ["c"]), lambda: [KNOWN],
                    mutations=TEXT),
    "speed": Reader(of("pytest_cpas.timing.records", "read_record"), lambda: [SPEED],
                    mutations=TEXT),
    "trace": Reader(traced, trace_lines, ".jsonl", mutations=(leaf_of_line, leaf_of_line, *TEXT)),
    "parity map": Reader(of("pytest_cpas.traces.maps", "read_map"), lambda: [PARITY_MAP], ".toml",
                         mutations=TEXT),
    "report": Reader(reported, lambda: [a_report(), b'{"format": 2, "runs": []}', JSON], ".json",
                     mutations=(leaf, leaf, leaf, *TEXT),
                     covers=("schemas.check_schema",)),
}  # fmt: skip

#: Those that are not handed the path, or a link to it: they are about what is in a file.
WITHOUT_PATH = ("detections", "numbers", "golden", "golden points", "older golden")

# -- running ------------------------------------------------------------------------------------


def case(name: str, number: int) -> bytes:
    """The content of a case: the same for the same name and number."""
    reader = READERS[name]
    dice = random.Random(f"{name} {number}")
    content = dice.choice(reader.seeds())
    for mutate in dice.sample(
        (damaged, *reader.mutations), k=1 if dice.random() < 0.8 or not reader.mutations else 2
    ):
        content = mutate(content, dice)
    return content


def peak_memory() -> int:
    """Most bytes that this process has had in memory."""
    (kibibytes,) = re.findall(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(kibibytes) * 1024


#: Most seconds that a case took in this process, and most bytes by which its memory grew.
worst: list[float] = [0.0, 0]


def complaint(name: str, path: Path, errors: tuple[type[Exception], ...]) -> str:
    """What is wrong with how a reader takes a file; "" if nothing is."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak is that of this case
    before, start = peak_memory(), time.process_time()
    try:
        READERS[name].run(path)
        told = ""
    except errors as error:
        told = str(error)
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, MemoryError):
                return f"{type(cause).__name__} behind {told[:200]}"
            cause = cause.__cause__ or cause.__context__
        if name not in WITHOUT_PATH and path.name not in told:
            return f"the error does not name the file: {told[:300]}"
    except BaseException:
        return traceback.format_exc()
    seconds = time.process_time() - start  # others may be busy
    grown = peak_memory() - before
    worst[:] = max(worst[0], seconds), max(worst[1], grown)
    slow = f"{seconds:.2f} s ({told[:100]})" if seconds > SECONDS else ""
    large = f"{grown / 2**20:.0f} MiB more memory" if grown > MEMORY else ""
    return " ".join(filter(None, (slow, large)))


def work(name: str, first: int, count: int, folder: Path) -> None:
    """Run cases in this process; complaints go to standard output, as JSON lines."""
    faulthandler.enable()
    warnings.simplefilter("ignore")
    errors = own_errors()
    for seed in READERS[name].seeds():  # imports, and what is compiled, take no case's second
        path = folder / f"seed{READERS[name].suffix}"
        path.write_bytes(seed)
        with suppress(*errors):
            READERS[name].run(path)
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2 * MEMORY, hard))
    for number in range(first, first + count):
        print(json.dumps({"begun": number}), flush=True)
        path = folder / f"case{number}{READERS[name].suffix}"
        path.write_bytes(case(name, number))
        wrong = complaint(name, path, errors)
        path.unlink()
        if wrong:
            print(json.dumps({"wrong": wrong, "number": number}), flush=True)
    print(json.dumps({"worst": worst}), flush=True)


def fuzz(name: str, first: int, count: int) -> list[str]:
    """Complaints about ``count`` cases of a reader, in a process of their own; ``worst`` is its."""
    found = []
    worst[:] = 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "work", name, str(first), str(count), folder]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60 + 2 * count)
    begun = -1
    for line in done.stdout.splitlines():
        value = json.loads(line)
        begun = value.get("begun", begun)
        worst[:] = value.get("worst", worst)
        if "wrong" in value:
            found.append(f"{name}, case {value['number']}: {value['wrong']}")
    if done.returncode:
        found.append(f"{name}, case {begun}: exit {done.returncode}\n{done.stderr[-3000:]}")
    return found


def guided(name: str, seconds: int) -> None:
    """The same by coverage, in this process, until something is found or the time is over."""
    import atheris

    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as corpus:
        path = Path(folder) / f"case{READERS[name].suffix}"
        # what is imported from here on counts what it covers
        with atheris.instrument_imports(include=["pytest_cpas.reading", "tomllib", "yaml"]):
            path.write_bytes(READERS[name].seeds()[0])
            with suppress(Exception):
                READERS[name].run(path)
        errors = own_errors()
        for index, seed in enumerate(READERS[name].seeds()):
            (Path(corpus) / str(index)).write_bytes(seed)

        def once(content: bytes) -> None:
            path.write_bytes(content)
            if wrong := complaint(name, path, errors):
                raise RuntimeError(f"{name}: {wrong}")

        options = [f"-max_total_time={seconds}", "-rss_limit_mb=4096", "-timeout=5", corpus]
        atheris.Setup([sys.argv[0], *options], once)
        atheris.Fuzz()


def main(arguments: list[str]) -> int:
    if arguments[:1] == ["work"]:
        name, first, count, folder = arguments[1:]
        work(name, int(first), int(count), Path(folder))
        return 0
    if arguments[:1] == ["guided"]:
        guided(arguments[1], int(arguments[2]))
        return 0
    if arguments[:1] == ["--atheris"]:
        ends = {
            name: subprocess.run(
                [sys.executable, __file__, "guided", name, arguments[1]]
            ).returncode
            for name in READERS
        }
        print(ends)
        return int(any(ends.values()))
    count, seed = int(arguments[0]), int(arguments[1]) if arguments[1:] else 0
    each = -(-count // len(READERS))
    wrong = []
    for name in READERS:
        start = time.perf_counter()
        found = fuzz(name, seed * 1_000_000, each)
        wrong += found
        print(
            f"{name}: {each} cases, {len(found)} wrong, {time.perf_counter() - start:.1f} s;"
            f" the worst took {worst[0]:.3f} s and {worst[1] / 2**20:.1f} MiB",
            flush=True,
        )
        print("\n".join(found[:5]))
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
