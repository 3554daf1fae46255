"""Results files byte by byte: torn, mixed, written by two, taken away; whose rows they hold."""

import hashlib
import json
import multiprocessing
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from tables import REFS, Fixed, rows, with_facts

from pytest_cpas.evaluation import ResultsError, ResultsFile, Shard, merge, read_results
from pytest_cpas.evaluation.results import FORMAT

WHOLE = Shard(1, 1)


def a_run(*, data: str = "x", code: str = "c0de", refs=REFS, **more: str) -> Fixed:
    run = Fixed("m", "d", refs, identity={"data": data})
    run.provenance = {**run.provenance, "code": code, "packages": "python 3", **more}
    return run


def write(folder: Path, some, run=None, **options) -> Path:
    with ResultsFile(folder, run or a_run(), WHOLE, **options) as file:
        for row in some:
            if row.sample not in file.rows:
                file.add(row)
    return file.path


def lines(path: Path) -> list[bytes]:
    return path.read_bytes().splitlines(keepends=True)


@pytest.mark.parametrize("kind", ["cut", "then a newline"])
def test_resumed_from_every_byte(tmp_path, kind):
    """Wherever a disk filled or a kill fell, the same command goes on and loses no whole line."""
    whole = write(tmp_path / "whole", rows()[:3]).read_bytes()
    for end in range(len(whole) + 1):
        folder = tmp_path / "cut"
        folder.mkdir()
        path = folder / "m-d.jsonl"
        path.write_bytes(whole[:end])
        complete = whole[:end].count(b"\n")
        if kind == "cut":
            file = ResultsFile(folder, a_run(), WHOLE)
            assert len(file.rows) == max(complete - 1, 0)
            assert write(folder, rows()) == path
            assert list(read_results(path).rows.values()) == rows()
        elif not whole[:end].endswith(b"\n") and end:
            path.write_bytes(whole[:end] + b"\n")
            if whole[end:].startswith(b"\n"):
                ResultsFile(folder, a_run(), WHOLE)
            else:
                with pytest.raises(ResultsError, match=f"line {complete + 1}: its checksum"):
                    ResultsFile(folder, a_run(), WHOLE)
        shutil.rmtree(folder)


@pytest.mark.parametrize(
    "content", [b"hello", b'0123456789abcdef {"rows"', b"# notes", b"0123 {", b"\0" * 20]
)
def test_a_file_of_somebody_else_is_not_taken_for_a_torn_one(tmp_path, content):
    (tmp_path / "m-d.jsonl").write_bytes(content)
    with pytest.raises(ResultsError, match="does not begin with the header"):
        ResultsFile(tmp_path, a_run(), WHOLE)
    assert (tmp_path / "m-d.jsonl").read_bytes() == content


def test_every_foreign_line_is_refused_by_its_number(tmp_path):
    """Lines of another file of the very same run, wherever they are put; lines moved, repeated or
    taken out."""
    ours = write(tmp_path / "a", rows()[:5])
    theirs = write(tmp_path / "b", rows(**{f"s_{i:02d}": 9 for i in range(10)}))
    mine, other = lines(ours), lines(theirs)
    spoilt = [([*mine, line], len(mine) + 1) for line in other[1:]]
    spoilt += [([*mine[:at], line, *mine[at:]], at + 1) for at in (1, 3) for line in other[1:]]
    spoilt += [([*mine[:at], line, *mine[at + 1 :]], at + 1) for at in (1, 3) for line in other[1:]]
    spoilt += [([*mine, mine[at]], len(mine) + 1) for at in range(len(mine))]
    spoilt += [([*mine[:at], *mine[at + 1 :]], at + 1) for at in range(1, len(mine) - 1)]
    spoilt += [([*mine[:2], mine[3], mine[2], *mine[4:]], 3)]
    spoilt += [([other[0], *mine[1:]], 2)]
    for content, number in spoilt:
        ours.write_bytes(b"".join(content))
        with pytest.raises(ResultsError, match=f"line {number}: its checksum is wrong"):
            read_results(ours)
        with pytest.raises(ResultsError, match=f"line {number}: its checksum is wrong"):
            merge([ours])


def test_second_row_of_a_sample_is_refused(tmp_path):
    path = write(tmp_path, rows()[:2])
    with ResultsFile(tmp_path, a_run(), WHOLE) as file:
        file.add(with_facts(rows()[0], rotation_deg=1.0))
    with pytest.raises(ResultsError, match=r"line 4: .*sample s/00 has a row already"):
        read_results(path)


def test_rows_of_samples_that_the_run_lacks_are_refused(tmp_path):
    write(tmp_path, rows())
    few = a_run()
    few.samples = few.samples[:9]
    with pytest.raises(ResultsError, match="selected was 10, now 9"):
        ResultsFile(tmp_path, few, WHOLE)
    other = a_run()
    other.samples = [replace(ref, id=ref.id.replace("s/", "t/")) for ref in other.samples]
    with pytest.raises(ResultsError, match="has 10 samples that this run does not have"):
        ResultsFile(tmp_path, other, WHOLE)


# -- two at once, and files that go away ----------------------------------------------------------


def _hold(folder: Path, ready, done) -> None:
    with ResultsFile(folder, a_run(), WHOLE) as file:
        file.add(rows()[0])
        ready.set()
        done.wait(60)


def test_second_writer_is_refused(tmp_path):
    context = multiprocessing.get_context("spawn")
    ready, done = context.Event(), context.Event()
    early = ResultsFile(tmp_path, a_run(), WHOLE)
    writer = context.Process(target=_hold, args=(tmp_path, ready, done))
    writer.start()
    assert ready.wait(60)
    for file in (early, ResultsFile(tmp_path, a_run(), WHOLE)):
        with pytest.raises(ResultsError, match="another run is writing it"), file:
            pass
    with pytest.raises(ResultsError, match="another run is writing it"):
        ResultsFile(tmp_path, a_run(), WHOLE).check_free()  # before anything is loaded
    done.set()
    writer.join()
    assert writer.exitcode == 0
    with pytest.raises(ResultsError, match="has written it since this one began"), early:
        pass
    assert list(read_results(early.path).rows) == ["s/00"]
    ResultsFile(tmp_path, a_run(), WHOLE).check_free()
    write(tmp_path, rows())
    assert len(read_results(early.path).rows) == 10


@pytest.mark.parametrize("away", ["file", "folder", "other folder", "other file"])
def test_file_that_goes_away_ends_the_run(tmp_path, away):
    folder = tmp_path / "out"

    def run(another: bool) -> None:
        with ResultsFile(folder, a_run(), WHOLE) as file:
            file.add(rows()[0])
            if away == "file":
                file.path.unlink()
            elif away == "folder":
                shutil.rmtree(folder)
            elif away == "other folder":
                folder.rename(tmp_path / f"moved-{another}")
                write(folder, rows())
            else:
                file.path.rename(tmp_path / f"moved-{another}")
                file.path.write_bytes(b"")
            if another:
                file.add(rows()[1])

    for another in (True, False):
        shutil.rmtree(folder, ignore_errors=True)
        with pytest.raises(ResultsError, match="was removed or replaced while this run"):
            run(another)


@pytest.mark.parametrize("then", ["another row", "the end"])
def test_what_somebody_else_wrote_is_noticed(tmp_path, then):
    """A method that writes to every descriptor it finds, or another program."""

    def run() -> None:
        with ResultsFile(tmp_path, a_run(), WHOLE) as file:
            file.add(rows()[0])
            with file.path.open("ab") as other:
                other.write(b"garbage")
            if then == "another row":
                file.add(rows()[1])

    with pytest.raises(ResultsError, match=r"and this run knows of \d+: a method, a plugin"):
        run()


@pytest.mark.parametrize("then", ["another row", "the end"])
@pytest.mark.parametrize("left", [0, 1, 100, 1500, -1])
def test_file_that_is_cut_off_is_gone_on_with(tmp_path, left, then):
    """By a tool that empties files, or a disk that was restored."""

    def run() -> None:
        with ResultsFile(tmp_path, a_run(), WHOLE) as file:
            for row in rows()[:4]:
                file.add(row)
            os.truncate(file.path, left % file.path.stat().st_size)
            if then == "another row":
                file.add(rows()[4])

    with pytest.raises(ResultsError, match=r"cut off at \d+ bytes while .* goes on from what is"):
        run()
    kept = ResultsFile(tmp_path, a_run(), WHOLE).rows
    assert len(kept) == {0: 0, 1: 0, 100: 0, -1: 3}.get(left, len(kept))
    assert list(read_results(write(tmp_path, rows())).rows.values()) == rows()


@pytest.mark.parametrize("then", ["another row", "the end"])
def test_descriptor_that_was_closed_is_noticed(tmp_path, then):
    def run() -> None:
        with ResultsFile(tmp_path, a_run(), WHOLE) as file:
            file.add(rows()[0])
            os.close(file._file.fileno())
            if then == "another row":
                file.add(rows()[1])

    with pytest.raises(ResultsError, match="cannot be written"):
        run()
    assert len(read_results(tmp_path / "m-d.jsonl").rows) == 1


# -- whose rows -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changed", [{"code": "0ther"}, {"packages": "torch 3"}, {"python": "3.99"}, {"numpy": "9"}]
)
def test_rows_of_another_program_are_set_aside(tmp_path, changed):
    before = write(tmp_path, rows()).read_bytes()
    run = a_run(**changed)
    file = ResultsFile(tmp_path, run, WHOLE)
    assert (len(file.rows), file.set_aside.rows) == (0, 10)
    assert next(iter(changed)) in str(file.set_aside)
    path = write(tmp_path, rows(s_03=9)[:4], run)
    assert len(read_results(path).rows) == 4
    assert (tmp_path / "m-d.1.old").read_bytes() == before
    write(tmp_path, rows(), a_run(code="third"))
    assert {p.name for p in tmp_path.iterdir()} == {"m-d.jsonl", "m-d.1.old", "m-d.2.old"}


def test_reused_on_purpose_is_never_forgotten(tmp_path):
    write(tmp_path, rows()[:4])
    path = write(tmp_path, rows(), a_run(code="0ther"), reuse_any=True)
    (run,) = merge([path])
    assert run.provenance["code"] == "c0de and 0ther"
    assert len(read_results(path).rows) == 10
    # neither program finds its own rows alone
    for code in ("c0de", "0ther"):
        assert not ResultsFile(tmp_path, a_run(code=code), WHOLE).rows


def test_a_file_of_another_program_is_named(tmp_path):
    def run(**files: str) -> Fixed:
        made = a_run()
        made.files = files
        return made

    write(tmp_path, rows()[:4], run(**{"a.py": "1", "b.py": "1"}))
    assert len(ResultsFile(tmp_path, run(**{"a.py": "1", "b.py": "1"}), WHOLE).rows) == 4
    other = run(**{"a.py": "2", "c.py": "1"})
    told = "not reused 4 of another program (changed: a.py; new: c.py; gone: b.py)"
    assert str(ResultsFile(tmp_path, other, WHOLE).set_aside) == told
    path = write(tmp_path, rows(), other, reuse_any=True)
    assert read_results(path).header.files["a.py"] == "1 and 2"
    assert not ResultsFile(tmp_path, other, WHOLE).rows


def test_another_revision_of_the_same_code_is_the_same_program(tmp_path):
    write(tmp_path, rows()[:4], a_run(revision="abc"))
    assert len(ResultsFile(tmp_path, a_run(revision="def+"), WHOLE).rows) == 4


@pytest.mark.parametrize(("key", "whose"), [("code", "method's"), ("data_code", "data set's")])
def test_unseen_sources_are_never_the_same(tmp_path, key, whose):
    write(tmp_path, rows()[:4], a_run(**{key: "unknown"}))
    file = ResultsFile(tmp_path, a_run(**{key: "unknown"}), WHOLE)
    assert not file.rows
    assert f"the {whose} sources are in no file" in str(file.set_aside)


def test_shards_of_two_programs_are_not_merged(tmp_path):
    paths = []
    for index, code in ((1, "a"), (2, "b")):
        run = a_run(code=code)
        run.samples = run.samples[index - 1 :: 2]
        with ResultsFile(tmp_path, run, Shard(index, 2)) as file:
            for row in rows()[index - 1 :: 2]:
                file.add(row)
        paths.append(file.path)
    with pytest.raises(ResultsError, match=r"different programs: code was a, now b\. --cpas-res"):
        merge(paths)
    (run,) = merge(paths, any_program=True)
    assert run.provenance["code"] == "a and b"


def test_older_format_is_named(tmp_path):
    path = write(tmp_path, [])
    text = lines(path)[0].split(b" ", 1)[1]
    older = json.dumps({**json.loads(text), "format": 4}).encode()
    path.write_bytes(hashlib.sha256(older).hexdigest()[:16].encode() + b" " + older + b"\n")
    with pytest.raises(ResultsError, match=f"format 4, this version reads {FORMAT}"):
        read_results(path)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_folder_without_permission(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(ResultsError, match="cannot be written"):
        write(tmp_path / "out", rows())
