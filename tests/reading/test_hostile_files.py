"""Files that are not what they should be: each ends in one clear line with the file and the place,
or is read rightly."""

import hashlib
import io
import json
import os
import re
import struct
import time
import zipfile
from pathlib import Path

import fuzzing
import numpy as np
import pytest

from pytest_cpas.evaluation import ResultsError, SampleError, StoredRun, merge, read_results
from pytest_cpas.evaluation.results import checksum_of
from pytest_cpas.golden import GoldenError
from pytest_cpas.golden.files import read_golden
from pytest_cpas.reading import checkpoints
from pytest_cpas.reading.archives import ArchiveError, unpack
from pytest_cpas.reading.arrays import LARGEST_ARRAYS, MOST_ARRAYS, read_npz
from pytest_cpas.reading.checkpoints import read_tensors
from pytest_cpas.reading.files import opened, read_bytes
from pytest_cpas.reading.images import read_rgb
from pytest_cpas.reading.meshes import read_mesh
from pytest_cpas.reading.structured import DEEPEST, parse_toml, read_json, read_toml, read_yaml
from pytest_cpas.types import AnswerError, Camera, DataError, Prediction

# -- files that are none -------------------------------------------------------------------------


def odd(kind: str, folder: Path) -> Path:
    path = folder / "odd"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "nothing":
        pass
    else:
        path.symlink_to(kind)
    return path


ODD = {
    "pipe": "not a regular file, but a named pipe",
    "/dev/zero": "not a regular file, but a device",
    "/dev/full": "not a regular file, but a device",
    "folder": "not a regular file, but a folder",
    "nothing": "no such file",
    "long name": "File name too long",
}


#: No record is none; a folder of predictions is one of pickles.
OTHERWISE = {("speed", "nothing"), ("predictions", "nothing")} | {
    (form, "folder") for form in ("predictions", "forms", "catre", "bop", "matrices", "json lines")
}

OF_PATHS = [name for name in fuzzing.READERS if name not in fuzzing.WITHOUT_PATH]


@pytest.mark.parametrize("name", OF_PATHS)
@pytest.mark.parametrize("kind", ODD)
def test_what_is_no_file_is_refused_before_it_is_opened(kind, name, tmp_path):
    reader = fuzzing.READERS[name]
    if kind == "long name":
        path = tmp_path / ("x" * 300 + reader.suffix)
    else:
        path = odd(kind, tmp_path).with_suffix(reader.suffix)
        if kind != "nothing":
            (tmp_path / "odd").rename(path)
    if (name, kind) in OTHERWISE:
        return
    with pytest.raises(fuzzing.own_errors()) as raised:
        reader.run(path)
    assert re.search(f"{path.name[:4]}.*{ODD[kind]}", str(raised.value))


@pytest.mark.parametrize("kind", ["pipe", "/dev/zero", "/dev/full", "folder"])
@pytest.mark.parametrize(
    ("files", "made", "file"),
    [
        (files, made, file)
        for files, made in (
            (("table.toml", "samples.csv"), fuzzing.older_goldens),
            (fuzzing.GOLDEN_FILES, fuzzing.goldens),
        )
        for file in files
    ],
)
def test_golden_table_that_is_no_file(kind, files, made, file, tmp_path):
    place = tmp_path / "recorded" / "m" / "d"
    place.mkdir(parents=True)
    for name, content in zip(files, made()[0].split(fuzzing.SEPARATOR), strict=True):
        (place / name).write_bytes(content)
    assert len(read_golden(place).samples) == 4
    (place / file).unlink()
    odd(kind, place).rename(place / file)
    with pytest.raises(GoldenError, match=rf"{file}: {ODD[kind]}"):
        read_golden(place)


def test_pipe_that_takes_the_place_of_a_file_is_not_waited_for(tmp_path, monkeypatch):
    path = tmp_path / "x"
    os.mkfifo(path)
    monkeypatch.setattr("pytest_cpas.reading.files.regular", lambda path: path)
    with pytest.raises(DataError, match="named pipe"):
        read_bytes(path)


def test_limits_are_told(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(bytes(101))
    with pytest.raises(DataError, match="x: 101 bytes, at most 100 are read"):
        read_bytes(path, 100)


def test_no_more_memory_is_set_aside_than_the_file_is_large(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"abc")
    with opened(path) as file:
        assert file.read(2**62) == b"abc"


# -- structured text -------------------------------------------------------------------------------


@pytest.mark.parametrize("levels", [DEEPEST + 1, 900, 100_000])
@pytest.mark.parametrize(
    ("read", "text"),
    [
        (read_json, lambda n: '{"a":' * n + "1" + "}" * n),
        (read_json, lambda n: '{"a":' + "[" * n + "]" * n + "}"),
        (read_json, lambda n: "[" * n),
        (read_toml, lambda n: "a = " + "[" * n + "]" * n),
        (read_toml, lambda n: "a = " + "{a=" * n + "1" + "}" * n),
        (read_toml, lambda n: "a." * n + "a = 1"),
        (read_toml, lambda n: "[" + "a." * n + "a]"),
        (read_yaml, lambda n: "[" * n + "]" * n),
        (read_yaml, lambda n: "- " * min(n, 5000) + "a"),
        (read_yaml, lambda n: "a: &a [*a]"),
    ],
)
def test_depth_is_limited(read, text, levels, tmp_path):
    path = tmp_path / "deep"
    path.write_text(text(levels))
    with pytest.raises(DataError, match=rf"deep.*({DEEPEST} (levels deep|keys)|not readable)"):
        read(path)


def test_what_is_as_deep_as_may_be_is_read(tmp_path):
    path = tmp_path / "x"
    path.write_text('{"a":' * DEEPEST + '"}]\\"[{"' + "}" * DEEPEST)
    value = read_json(path)
    for _ in range(DEEPEST):
        value = value["a"]
    assert value == '}]"[{'
    path.write_text(json.dumps({"a": [[1]] * 1000}))
    assert len(read_json(path)["a"]) == 1000
    assert parse_toml("it", "a = 'e.g. ... this; ....'")["a"].startswith("e.g.")


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity"])
def test_json_has_no_such_number(number, tmp_path):
    path = tmp_path / "x.json"
    path.write_text(f'{{"a": {number}}}')
    with pytest.raises(DataError, match=rf"x\.json.*{number} is not JSON"):
        read_json(path)


# -- archives and arrays ---------------------------------------------------------------------------

SOUND = fuzzing.predictions()[0]


def arrays_with(**changed):
    with np.load(io.BytesIO(SOUND)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return fuzzing.saved(lambda file: np.savez(file, **arrays | changed))


def broken_zip(method=None, tail=None):
    target = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(SOUND)) as source, zipfile.ZipFile(target, "w") as made:
        for info in source.infolist():
            made.writestr(info.filename, source.read(info), method or zipfile.ZIP_DEFLATED)
    data = bytearray(target.getvalue())
    if tail:
        data[data.index(b"frame.npy") + 12 : data.index(b"frame.npy") + 40] = tail
    return bytes(data)


def unknown_method():
    data = bytearray(broken_zip())
    for match in re.finditer(rb"PK(\x01\x02|\x03\x04)", bytes(data)):
        at = match.start() + (10 if match[1] == b"\x01\x02" else 8)
        data[at : at + 2] = b"\x63\0"
    return bytes(data)


FRAMES = np.array(["scene_1_0000", "b"])
POSES = np.stack([np.diag([0.2, 0.2, 0.2, 1.0])] * 2)
NPZ = {
    "damaged deflate": (broken_zip(tail=b"\xff" * 28), "not a readable .npz"),
    "unknown compression": (unknown_method(), "compressed by method 99"),
    "bzip2": (broken_zip(zipfile.ZIP_BZIP2), "compressed by method 12"),
    "an npy": (fuzzing.saved(lambda f: np.save(f, np.eye(3))), "not a readable .npz"),
    "names of no dimension": (arrays_with(frame=np.array("a")), r"array frame: \(\) of <U1.*texts"),
    "names of two": (arrays_with(frame=FRAMES[None]), r"array frame: \(1, 2\).*of shape \(N\)"),
    "names of ints": (arrays_with(frame=np.arange(2)), "array frame: .*int64, expected texts"),
    "names of bytes": (arrays_with(frame=FRAMES.astype("S")), "expected texts"),
    "objects": (arrays_with(frame=FRAMES.astype(object)), "nothing is unpickled"),
    "empty offsets": (arrays_with(gt_offset=np.arange(0)), "gt_offset has 0 entries, expected 3"),
    "float offsets": (arrays_with(gt_offset=np.arange(3.0)), "gt_offset: .*expected integers"),
    "offsets down": (arrays_with(gt_offset=np.array([0, 3, 2])), "gt_offset goes down from 3 to 2"),
    "offsets negative": (arrays_with(pred_offset=np.array([0, -1, 2])), "goes down from 0 to -1"),
    "offsets beyond": (arrays_with(pred_offset=np.array([0, 1, 9])), "up to 9, expected 3"),
    "one id": (arrays_with(frame=np.array(["a/b_0", "a/b_0"])), "occurs twice|give one id"),
    "ids of no dimension": (arrays_with(gt_class_ids=np.array(2)), r"gt_class_ids: \(\) of int64"),
    "half ids": (arrays_with(gt_class_ids=np.array([2, 2.5])), "frame b: gt_class_ids.*2.5, not"),
    "ids NaN": (arrays_with(pred_class_ids=np.array([2, np.nan])), "class ids run from nan"),
    "id 9": (arrays_with(pred_class_ids=np.array([2, 9])), "class ids run from 9 to 9"),
    "boxes NaN": (arrays_with(gt_bboxes=np.full((2, 4), np.nan)), "gt_bboxes holds NaN"),
    "too few rows": (arrays_with(gt_RTs=POSES[:1]), "gt_RTs has 1 rows, expected 2"),
    "strange name": (arrays_with(frame=np.array(["\x1b[31m", "b"])), "frame .*printable"),
}


@pytest.mark.parametrize("attack", NPZ)
def test_npz_of_predictions(attack, tmp_path):
    content, words = NPZ[attack]
    path = tmp_path / "mine.npz"
    path.write_bytes(content)
    with pytest.raises(DataError, match=rf"mine\.npz.*({words})") as raised:
        StoredRun(path)
    assert len(str(raised.value).splitlines()) == 1


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.longdouble, ">f8"])
def test_numbers_of_any_size_are_read_rightly(kind, tmp_path):
    path = tmp_path / "mine.npz"
    ids = np.array([2, 6]).astype(kind)
    path.write_bytes(arrays_with(gt_RTs=POSES.astype(kind), gt_class_ids=ids))
    run = StoredRun(path)
    assert [ref.category for ref in run.samples] == ["bowl", "mug"]
    for ref in run.samples:
        assert run.judge(ref).facts["position_m"] == 0
        assert run.judge(ref).facts["iou"] == pytest.approx(1, abs=0.01)


def test_names_with_slashes_are_names(tmp_path):
    path = tmp_path / "mine.npz"
    path.write_bytes(arrays_with(frame=np.array(["a/b_0", "_1"])))
    run = StoredRun(path)
    assert [ref.id for ref in run.samples] == ["a/b_0/gt0", "1/gt0"]
    assert all(run.judge(ref).facts["position_m"] == 0 for ref in run.samples)


def test_pose_far_beyond_is_its_samples_fault(tmp_path):
    poses = POSES.copy()
    poses[0, 0, 3] = 1e200
    path = tmp_path / "mine.npz"
    path.write_bytes(arrays_with(pred_RTs=poses))
    run = StoredRun(path)
    with pytest.raises(
        SampleError, match=r"prediction 0 of scene_1_0000: the pose.*at most 1e[+]30"
    ):
        run.judge(run.samples[0])
    assert run.judge(run.samples[1]).facts["position_m"] == 0


def test_small_file_does_not_become_a_large_one(tmp_path):
    path = tmp_path / "bomb.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("a.npy", "w") as f,
    ):
        header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({LARGEST_ARRAYS + 1},), }}\n"
        f.write(b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode())
        for _ in range(LARGEST_ARRAYS // 2**20 + 1):
            f.write(bytes(2**20))
    with pytest.raises(DataError, match=f"at most {LARGEST_ARRAYS} are read; a bomb"):
        read_npz(path)


@pytest.mark.parametrize("name", ["x" * 300, "é" * 200, "a/" * 600 + "b"])
def test_archive_names_that_are_too_long(name, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(name, "x")
    with pytest.raises(ArchiveError, match=rf"a\.zip: .*has {len(name)} characters"):
        unpack(tmp_path / "a.zip", tmp_path / "to")
    assert list((tmp_path / "to").iterdir()) == []


# -- images, meshes, checkpoints -------------------------------------------------------------------


@pytest.mark.parametrize("length", [b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff"])
def test_png_chunk_of_negative_length(length, tmp_path):
    path = tmp_path / "x.png"
    content = fuzzing.images("RGB")()[0]
    camera = Camera(32, 24, 30, 30, 16, 12)
    path.write_bytes(content)
    whole = read_rgb(path, camera)
    for kind in (b"IHDR", b"IDAT"):
        data = bytearray(content)
        at = data.index(kind)
        data[at - 4 : at] = length
        path.write_bytes(data)
        if kind == b"IDAT":  # its values end where they end
            np.testing.assert_array_equal(read_rgb(path, camera), whole)
            continue
        with pytest.raises(DataError, match=r"x\.png: not a readable image"):
            read_rgb(path, camera)


CORNERS = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
OBJ = {
    "index 0": (CORNERS + "f 0 1 2\n", "names vertex 0; the first one is 1"),
    "index 0 with more": (CORNERS + "f 0/1/1 1/1/1 2/1/1\n", "names vertex 0"),
    "beyond": (CORNERS + "f 1 2 4\n", "names vertex 4, but there are 3"),
    "negative beyond": (CORNERS + "f -1 -2 -4\n", "names vertex -4, but there are 3"),
    "negative before others": (CORNERS + "f -1 -2 -3\n" + CORNERS, "count vertices backwards"),
    "NaN": (CORNERS.replace("1 0 0", "nan 0 0") + "f 1 2 3\n", "NaN or infinite"),
    "huge": (CORNERS.replace("1 0 0", "1e300 0 0") + "f 1 2 3\n", "at most 1e[+]30"),
    "fraction": (CORNERS + "f 1.5 2 3\n", "no integers"),
    "no vertex": (CORNERS + "f 1 2 /3\n", "line 4: a face has a corner without a vertex"),
    "empty": ("", "no triangles"),
}


@pytest.mark.parametrize("attack", OBJ)
def test_obj(attack, tmp_path):
    content, words = OBJ[attack]
    path = tmp_path / "x.obj"
    path.write_text(content)
    with pytest.raises(DataError, match=rf"x\.obj: .*({words})"):
        read_mesh(path)


def test_obj_that_counts_backwards_is_read_rightly(tmp_path):
    path = tmp_path / "x.obj"
    path.write_text(CORNERS + "f -3 -2 -1\n")
    mesh = read_mesh(path)
    np.testing.assert_array_equal(
        mesh.vertices[mesh.triangles[0]], np.eye(3)[[2, 0, 1]] * [1, 1, 0]
    )


def test_checkpoints(tmp_path):
    torch = pytest.importorskip("torch")
    from method_adapters._assets import AssetError
    from method_adapters._networks.running import read_checkpoint

    path = tmp_path / "w.pth"
    torch.save({0: torch.ones(2), 1: torch.ones(3)}, path)
    assert set(read_tensors(path)) == {0, 1}
    with pytest.raises(AssetError, match=r"w\.pth: its tensors are called 0, 1, expected names"):
        read_checkpoint(path)
    (tmp_path / "folder").mkdir()
    with pytest.raises(AssetError, match="folder: not a regular file, but a folder"):
        read_checkpoint(tmp_path / "folder")


def pickled(body: bytes) -> bytes:
    return b"\x80\x02" + body + b"."


def colliding(count: int, value: bytes = b"N") -> bytes:
    """Numbers that all have the same hash, and a value behind each."""
    numbers = (index * (2**61 - 1) for index in range(count))
    return b"".join(b"\x8a\x0c" + n.to_bytes(12, "little") + value for n in numbers)


PICKLES_IN_CHECKPOINTS = {
    "keys that collide": (pickled(b"}(" + colliding(20_000) + b"u"), "too many keys that are not"),
    "keys of an OrderedDict": (
        pickled(b"ccollections\nOrderedDict\n)R(" + colliding(20_000) + b"u"),
        "too many keys that are not text",
    ),
    "a set": (
        pickled(b"c__builtin__\nset\n(" + colliding(20_000, b"") + b"l\x85R"),
        "too many keys that are not text",
    ),
    "doubled": (
        pickled(b"]" + b"".join(b"q%ch%c\x86" % (i, i) for i in range(60))),
        "holds more than 6000000 values",
    ),
    "deep": (pickled(b"(" * 300), "nested too deep"),
    "torn": (b"\x80\x02}", "ends without the opcode STOP"),
}


@pytest.mark.parametrize("new", [True, False])
@pytest.mark.parametrize("attack", PICKLES_IN_CHECKPOINTS)
def test_checkpoint_that_would_keep_torch_busy(attack, new, tmp_path):
    torch = pytest.importorskip("torch")
    content, words = PICKLES_IN_CHECKPOINTS[attack]
    path, sound = tmp_path / "w.pth", tmp_path / "sound.pth"
    torch.save({"a": torch.ones(2)}, sound, _use_new_zipfile_serialization=new)
    if new:
        with zipfile.ZipFile(sound) as source, zipfile.ZipFile(path, "w") as made:
            for info in source.infolist():
                held = content if info.filename.endswith("data.pkl") else source.read(info)
                made.writestr(info.filename, held)
    else:
        path.write_bytes(content)
    start = time.process_time()
    with pytest.raises(DataError, match=rf"w\.pth.*{words}") as raised:
        read_tensors(path)
    assert time.process_time() - start < 1
    assert len(str(raised.value).splitlines()) == 1


def test_tensors_hold_all_of_their_values(tmp_path):
    torch = pytest.importorskip("torch")
    path = tmp_path / "w.pth"
    for tensor in (torch.zeros(1).expand(10**6, 10**6), torch.empty(10**15, device="meta")):
        torch.save({"a": [tensor]}, path)
        with pytest.raises(DataError, match=r"w\.pth: a tensor of shape .* needs \d+ bytes"):
            read_tensors(path)
    tied = torch.ones(500)
    torch.save({"a": tied, "b": tied.view(5, 100).T, "c": (tied, {"d": tied})}, path)
    assert read_tensors(path)["b"].shape == (100, 5)


# -- results, golden tables, answers ---------------------------------------------------------------


def results_with(edit) -> bytes:
    """A results file whose third line, a row, is another, under right checksums."""
    made, last = b"", b""
    for number, line in enumerate(fuzzing.results()[0].split(b"\n")[:-1]):
        text = line.partition(b" ")[2]
        if number == 2:
            value = json.loads(text)
            edit(value)
            text = json.dumps(value).encode()
        last = checksum_of(last, text)
        made += last + b" " + text + b"\n"
    return made


def cell(name, value):
    return lambda line: line["row"].__setitem__(name, value)


def part(name, value):
    """Of the answer under the first seed."""
    return lambda line: line["row"]["answers"][0].__setitem__(name, value)


def measured(name, value):
    return lambda line: line["row"]["answers"][0]["facts"].__setitem__(name, value)


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (measured("position_m", float("nan")), "position_m is nan, expected a number"),
        (measured("position_m", float("inf")), "position_m is inf"),
        (measured("position_m", "0.1"), "position_m is '0.1'"),
        (measured("rotation_deg", None), "rotation_deg is None"),
        (measured("rotation_deg", -1), "rotation_deg is -1"),
        (measured("rotation_deg", 181), "rotation_deg is 181, expected a number from 0 to 180"),
        (measured("rotation_deg", 10**400), "more than 256 digits"),
        (measured("rotation_deg", True), "rotation_deg is True"),
        (measured("iou", 1.5), "iou is 1.5, expected a number from 0 to 1"),
        (part("failure", 3), "failure is 3, expected a text"),
        (part("estimate", "bad!"), "estimate is 'bad!'"),
        (part("estimate", 7), "estimate is 7, expected a text"),
        (cell("shape", "AAAA"), "shape is 'AAAA'"),
        (cell("answers", []), r"answers is \[\], expected one for each seed"),
        (cell("answers", [3]), "answer is 3, expected estimate, facts, failure"),
        (measured("fscore", 0.1), "there is no fact 'fscore'"),
        (part("facts", 3), "facts is 3, expected a mapping"),
        (cell("more", 1), "row is .*, expected answers, shape"),
        (lambda line: line.__setitem__("row", None), "row is None"),
        (lambda line: line.__setitem__("ref", ["a", "mug", 3, ""]), "ref is 3, expected a text"),
        (lambda line: line.__setitem__("ref", "a"), "ref is 'a'"),
        (lambda line: line.__setitem__("row", json.loads("[" * 70 + "]" * 70)), "64 levels deep"),
    ],
)
def test_row_under_a_right_checksum(edit, words, tmp_path):
    path = tmp_path / "mine.jsonl"
    path.write_bytes(results_with(edit))
    for read in (read_results, lambda path: merge([path])):
        with pytest.raises(ResultsError, match=rf"mine\.jsonl, line 3: .*{words}"):
            read(path)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("0.01,", "nan,", "line 3: 'nan', expected a number from -inf"),
        ("0.01,", "-1,", "line 3: position_m is '-1', expected 0 to inf"),
        ("0.01,", "x,", "line 3: 'x', expected a number"),
        ("0.01,", '"\n', "line"),
        ("a/1,", "a/0,", "line 3: sample a/0 is there twice"),
        ("a/1,", "a" * 2_000_000 + ",", "line 3: more than 1048576 characters"),
    ],
)
def test_golden_samples_under_a_right_digest(old, new, words, tmp_path):
    toml, _, samples = fuzzing.older_goldens()[0].decode().partition(fuzzing.SEPARATOR.decode())
    samples = samples.replace(old, new, 1)
    toml = re.sub('(?<=samples_sha256 = ")\\w+', hashlib.sha256(samples.encode()).hexdigest(), toml)
    place = tmp_path / "recorded" / "m" / "d"
    place.mkdir(parents=True)
    (place / "table.toml").write_text(toml)
    (place / "samples.csv").write_text(samples)
    with pytest.raises(GoldenError, match=rf"recorded/m/d: samples\.csv, {words}"):
        read_golden(place)


def test_reason_may_be_an_exception():
    failed = Prediction.failed(ValueError("no\nroot"))
    assert failed.reason == "ValueError: no\nroot"
    assert Prediction.failed(KeyboardInterrupt()).reason == "KeyboardInterrupt"
    with pytest.raises(AnswerError, match="reason is a int"):
        Prediction.failed(3)


@pytest.mark.parametrize("where", [[], ["-n2"]])
def test_exception_as_reason_in_a_run(where, cpas, pytester):
    with (pytester.path / "tiny.py").open("a") as file:
        file.write(
            "\n\nclass Excuses(Perfect):\n"
            "    def answer(self, index):\n"
            "        return Prediction.failed(ValueError('no root'))\n"
        )
    result = cpas("Excuses", "--cpas-results=out", *where)
    output = result.stdout.str() + result.stderr.str()
    assert "Traceback" not in output
    (path,) = (pytester.path / "out").iterdir()
    assert {row.failure for row in read_results(path).rows.values()} == {"ValueError: no root"}


def test_data_set_of_a_long_name(pytester, cpas):
    with (pytester.path / "tiny.py").open("a") as file:
        file.write("\n\nclass Long(Tiny):\n    name = 'x' * 300\n")
    result = cpas("Perfect", "--cpas-results=out", dataset="Long")
    output = result.stdout.str() + result.stderr.str()
    assert "300 characters, at most" in output
    assert "Traceback" not in output


def listing(count: int) -> bytes:
    """An archive that is nothing but a list of so many members."""
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("a", b"")
    content = made.getvalue()
    begin, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    members = content[begin:end] * count
    tail = bytearray(content[end:])
    tail[8:12] = struct.pack("<HH", count & 0xFFFF, count & 0xFFFF)
    tail[12:16] = struct.pack("<I", len(members))
    return content[:begin] + members + tail


@pytest.mark.parametrize(
    ("read", "most"),
    [(read_npz, MOST_ARRAYS), (read_tensors, checkpoints._MOST_MEMBERS)],
    ids=["npz", "tensors"],
)
def test_lists_of_members_are_counted_before_they_are_parsed(read, most, tmp_path):
    pytest.importorskip("torch")
    path = tmp_path / "x.bin"
    path.write_bytes(listing(most + 1))
    start = time.process_time()
    with pytest.raises(DataError, match=rf"x\.bin: {most + 1} members, at most {most} are read"):
        read(path)
    assert time.process_time() - start < 1
