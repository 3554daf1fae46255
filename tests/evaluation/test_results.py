"""Rows on disk: resuming, shards, merging; whatever is done to the files."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from harness import RUN

from pytest_cpas.checks.contract import CONTRACT
from pytest_cpas.cli import main
from pytest_cpas.evaluation import Shard, merge, read_results


def table(result: pytest.RunResult) -> list[str]:
    """What a run says about precision and verdict."""
    lines = result.stdout.lines
    start = next(i for i, line in enumerate(lines) if line.startswith("correct "))
    return [line for line in lines[start:] if line and "==" not in line and "rows: " not in line]


@pytest.fixture
def shards(recorded, pytester):
    """Run a method in n shards and return their files; the last results folder is ``out``."""

    def run(method: str, count: int, *args: str) -> list[str]:
        for index in range(1, count + 1):
            recorded(method, f"--cpas-shard={index}/{count}", "--cpas-results=out", *args)
        return sorted(str(path) for path in (pytester.path / "out").iterdir())

    return run


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/", "a/b", "-1/3"])
def test_bad_shards(text):
    with pytest.raises(ValueError, match="expected i/n"):
        Shard.parse(text)


@pytest.mark.thinned(4)
@pytest.mark.parametrize("count", [1, 3, 5])
@pytest.mark.parametrize("method", ["Perfect", "Biased", "Refuses"])
def test_merged_shards_are_judged_like_the_whole(recorded, pytester, shards, method, count):
    whole = recorded(method, "--cpas-require-golden")
    files = shards(method, count)
    assert len(files) == count
    merged = pytester.runpytest_inprocess(
        *RUN, "--cpas-require-golden", *(f"--cpas-merge={file}" for file in files)
    )
    assert merged.ret == whole.ret
    assert table(merged) == table(whole)


def test_shards_partition_the_samples(shards):
    samples = [set(read_results(Path(f)).rows) for f in shards("Perfect", 5)]
    assert sum(map(len, samples)) == len(set.union(*samples)) == 12


def test_failed_sample_of_a_shard_fails_the_merged_run(pytester, shards):
    files = shards("Raises", 2)
    merged = pytester.runpytest_inprocess(*RUN, *(f"--cpas-merge={file}" for file in files))
    assert merged.ret == 1
    merged.assert_outcomes(passed=29, failed=1, skipped=8)
    merged.stdout.fnmatch_lines(["*the method raised RuntimeError('the network exploded')*"])


def test_golden_table_is_recorded_from_merged_shards(pytester, shards):
    folder = pytester.path / "golden" / "recorded" / "perfect" / "tiny"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    files = shards("Perfect", 3)
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()
    args = [f"--cpas-merge={file}" for file in files]
    assert pytester.runpytest_inprocess(*RUN, "--snapshot-update", *args).ret == 0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def usage_error(pytester: pytest.Pytester, *args: str) -> str:
    result = pytester.runpytest_inprocess(*RUN, *args)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert "Traceback" not in result.stderr.str()
    return result.stderr.str()


def test_gaps_are_refused_unless_asked_for(pytester, shards):
    files = shards("Perfect", 3)
    args = [f"--cpas-merge={file}" for file in files[:2]]
    assert "shard 3/3 is missing" in usage_error(pytester, *args)
    result = pytester.runpytest_inprocess(*RUN, *args, "--cpas-allow-gaps")
    assert result.ret == 0
    result.stdout.fnmatch_lines(["8 of 12 samples judged", "golden: NOT CHECKED (bowl, mug)"])
    path = Path(files[2])
    path.write_bytes(b"\n".join(path.read_bytes().split(b"\n")[:-2]) + b"\n")
    error = usage_error(pytester, *(f"--cpas-merge={file}" for file in files))
    assert "has 3 of its 4 samples" in error


def test_overlaps_and_strangers_are_refused(recorded, pytester, shards):
    files = shards("Perfect", 2)
    again = Path(files[0]).rename(pytester.path / "again.jsonl")
    shards("Perfect", 2)  # writes the first one anew
    args = [f"--cpas-merge={file}" for file in (*files, again)]
    assert "are both shard 1/2" in usage_error(pytester, *args)
    recorded("Perfect", "--cpas-shard=1/3", "--cpas-results=other")
    (other,) = (pytester.path / "other").iterdir()
    assert "shards are 2, now 3" in usage_error(
        pytester, f"--cpas-merge={files[1]}", f"--cpas-merge={other}"
    )
    recorded("Perfect", "--cpas-shard=2/2", "--cpas-results=seeded", "--cpas-seed=1")
    (seeded,) = (pytester.path / "seeded").iterdir()
    error = usage_error(pytester, f"--cpas-merge={files[0]}", f"--cpas-merge={seeded}")
    assert "seed was 0, now 1" in error


def test_merge_command(pytester, shards, monkeypatch, capsys):
    files = shards("Biased", 2)
    monkeypatch.chdir(pytester.path)
    assert main(["merge", *files, *RUN]) == 1
    assert "golden: REGRESSED mug: 5 deg, 1 cm: 6 -> 0 of 6 correct" in capsys.readouterr().out
    assert main(["merge", files[0], *RUN]) == 4
    assert main(["merge", files[0], "--cpas-allow-gaps", *RUN]) == 0  # the shard of the bowls
    assert main(["merge", files[1], "--cpas-allow-gaps", *RUN]) == 1


# -- resuming ---------------------------------------------------------------------------------


def contents(file: bytes) -> list[bytes]:
    """The lines behind the header, in any order, without what tells their order."""
    return sorted(line.partition(b" ")[2] for line in file.splitlines()[1:])


@pytest.mark.minutes
def test_run_goes_on_after_every_kind_of_cut(recorded, pytester):
    """Cut the file at every line, and within lines, as a killed writer would leave it."""
    whole = recorded("Perfect", "--cpas-results=out", "--cpas-require-golden")
    (path,) = (pytester.path / "out").iterdir()
    content = path.read_bytes()
    ends = [i + 1 for i, byte in enumerate(content) if byte == ord("\n")]
    for end in [*ends[::4], *(e + 20 for e in ends[:-1:4])]:
        path.write_bytes(content[:end])
        resumed = recorded("Perfect", "--cpas-results=out", "--cpas-require-golden")
        assert resumed.ret == 0
        assert table(resumed) == table(whole)
        assert contents(path.read_bytes()) == contents(content)


def test_done_samples_are_not_judged_again(recorded, pytester):
    recorded("Perfect", "--cpas-results=out", "-k", "bowl")
    resumed = recorded("Perfect", "--cpas-results=out")
    assert resumed.ret == 0
    # a method that would break every sample finds nothing left to do
    (path,) = (pytester.path / "out").iterdir()
    assert len(read_results(path).rows) == 12
    reuse = ("--cpas-results=out", "--cpas-results-reuse=any")
    kept = recorded("WrongLength", *reuse, "-k", "test_sample")
    assert kept.ret == 0
    kept.stdout.fnmatch_lines([f"rows: reused 12 of another program from *{path.name}"])
    assert recorded("WrongLength", *reuse).ret == 1  # its contract is looked at


def test_errors_are_tried_again(recorded, pytester):
    assert recorded("Raises", "--cpas-results=out").ret == 1
    (path,) = (pytester.path / "out").iterdir()
    assert list(read_results(path).errors) == ["scene_1/0005"]
    assert recorded("Perfect", "--cpas-results=out", "--cpas-results-reuse=any").ret == 0
    assert read_results(path).errors == {}
    assert len(read_results(path).rows) == 12


def test_results_of_another_run_are_not_mixed_in(recorded, pytester):
    recorded("Perfect", "--cpas-results=out")
    names = ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Renewed", "--cpas-results=out")
    error = usage_error(pytester, *names)
    assert "data was tiny-1, now tiny-2" in error
    names = ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny", "--cpas-results=out")
    assert "selected was 12, now 3" in usage_error(pytester, *names, "--cpas-limit=3")


@pytest.mark.minutes
def test_every_damage_is_noticed(recorded, pytester):
    recorded("Perfect", "--cpas-results=out")
    (path,) = (pytester.path / "out").iterdir()
    whole = path.read_bytes()
    for position in range(0, len(whole) - 1, 97):
        damaged = bytearray(whole)
        damaged[position] ^= 1
        path.write_bytes(damaged)
        error = usage_error(pytester, f"--cpas-merge={path}")
        assert "checksum is wrong" in error
    for content, words in (
        (b"", "does not begin with the header"),
        (b'0123456789abcdef {"header":', "does not begin with the header"),
        (b"hello\n", "checksum is wrong"),
        (b"e3b0c44298fc1c14 \n", "did not write it"),
        (os.urandom(300) + b"\n", "checksum is wrong"),
    ):
        path.write_bytes(content)
        assert words in usage_error(pytester, f"--cpas-merge={path}")
    assert "nowhere.jsonl: no such file" in usage_error(pytester, "--cpas-merge=nowhere.jsonl")


def test_full_disk_ends_the_run_and_loses_nothing(recorded, pytester):
    """A limit on the size of files stands for the disk: writing fails half-way through a line."""
    whole = recorded("Perfect", "--cpas-require-golden")
    names = ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny", "--cpas-results=out")
    pytester.makeconftest(
        """
        import resource
        def pytest_runtestloop():
            resource.setrlimit(resource.RLIMIT_FSIZE, (6000, resource.RLIM_INFINITY))
        """
    )
    result = pytester.runpytest_subprocess(*RUN, *names)
    assert result.ret == pytest.ExitCode.INTERRUPTED
    output = result.stdout.str() + result.stderr.str()
    assert "cannot be written ([Errno 27] File too large); what it holds is good" in output
    assert "Traceback" not in output
    (path,) = (pytester.path / "out").iterdir()
    assert not path.read_bytes().endswith(b"\n")
    assert 0 < len(read_results(path).rows) < 12
    pytester.makeconftest("")
    resumed = recorded("Perfect", "--cpas-results=out", "--cpas-require-golden")
    assert (resumed.ret, table(resumed)) == (0, table(whole))


SLOW = """
import time
from tiny import *

class Slow(Perfect):
    def predict(self, batch, seed):
        time.sleep(0.02)
        return super().predict(batch, seed)
"""


@pytest.mark.minutes
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_killed_runs_end_with_the_same_table(recorded, pytester, how):
    """kill -9 of the whole run at random moments, until it is through."""
    pytester.makepyfile(slow=SLOW)
    names = ("--cpas-method=slow:Slow", "--cpas-dataset=tiny:Tiny", "--cpas-results=out")
    command = [sys.executable, "-m", "pytest", *RUN, *names, "--cpas-require-golden", *how]
    rng = random.Random(1)
    whole = recorded("Perfect", "--cpas-require-golden")
    killed = 0
    for _ in range(4):
        process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT, start_new_session=True
        )
        deadline = time.monotonic() + 60
        folder = pytester.path / "out"
        grown = rng.randrange(1, 9)
        while process.poll() is None and time.monotonic() < deadline:
            lines = sum(len(p.read_bytes().splitlines()) for p in folder.glob("*"))
            if lines > grown:
                os.killpg(process.pid, signal.SIGKILL)
                killed += process.wait() == -signal.SIGKILL
            time.sleep(0.002)
    final = pytester.runpytest_subprocess(*command[3:])
    assert killed, "no run was killed: this test proves nothing"
    assert final.ret == 0
    assert table(final) == table(whole)


def test_files_are_plain_json_behind_their_checksum(recorded, pytester):
    recorded("Refuses", "--cpas-results=out")
    (path,) = (pytester.path / "out").iterdir()
    header, *found = [json.loads(line[17:]) for line in path.read_text().splitlines()]
    rows = [value for value in found if "row" in value]
    assert header["header"]["listed"] == {"bowl": 6, "mug": 6}
    answers = [answer for row in rows for answer in row["row"]["answers"]]
    assert {answer["failure"] for answer in answers} == {None, "too few points"}
    assert {v["contract"]["check"] for v in found if "contract" in v} == CONTRACT.keys()
    heard = [value for value in found if "opened" in value]
    assert len(found) - len(heard) == len(rows) + len(CONTRACT) == 12 + len(CONTRACT)
    assert [run.method for run in merge([path])] == ["perfect"]


# -- whose rows ---------------------------------------------------------------------------------

GOOD = """
from tiny import *

class Mine(Perfect):
    info = replace(Perfect.info, name="mine")
"""

BROKEN = (
    GOOD
    + """
    def predict(self, batch, seed):
        return [Prediction.failed("broken") for _ in batch]
"""
)


@pytest.fixture
def mine(cpas, pytester):
    """Run a method of a module of one's own, whose text is given."""

    def run(text: str, *args: str) -> pytest.RunResult:
        pytester.makepyfile(mine=text)
        names = ("--cpas-method=mine:Mine", "--cpas-dataset=tiny:Tiny")
        return pytester.runpytest_subprocess(*RUN, *names, *args)

    cpas("Perfect", "--collect-only")  # has tiny copied
    assert run(GOOD, "--snapshot-update").ret == 0
    return run


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_rows_of_a_program_that_was_broken_since_are_not_believed(mine, pytester, how):
    keep = ("--cpas-results=out", "--cpas-require-golden", *how)
    good = mine(GOOD, *keep)
    assert good.ret == 0
    good.stdout.fnmatch_lines(["rows: computed 12"])
    again = mine(GOOD, *keep)
    assert again.ret == 0
    again.stdout.fnmatch_lines(["rows: reused 12 from *mine-tiny.jsonl"])
    broken = mine(BROKEN, *keep)
    assert broken.ret == 1
    broken.stdout.fnmatch_lines(
        ["rows: computed 12, not reused 12 of another program (code was *, now *)", "*REGRESSED*"]
    )
    mended = mine(GOOD, *keep)
    assert mended.ret == 0
    mended.stdout.fnmatch_lines(["rows: computed 12, not reused 12*", "*MATCHES*"])
    assert {path.name for path in (pytester.path / "out").iterdir()} == {
        "mine-tiny.jsonl",
        "mine-tiny.1.old",
        "mine-tiny.2.old",
    }


@pytest.mark.parametrize("changed", ["conftest.py", "weights/data.bin"])
def test_rows_are_not_believed_beside_another_conftest_or_other_weights(mine, pytester, changed):
    """What no import tells: a conftest can replace anything, and a method reads what it likes of a
    folder of weights that it declares nothing of."""
    path = pytester.path / changed
    path.parent.mkdir(exist_ok=True)
    path.write_text("one = 1\n")
    (pytester.path / "weights").mkdir(exist_ok=True)
    keep = ("--cpas-results=out", "--cpas-weights=weights", "-k", "test_sample")
    mine(GOOD, *keep).stdout.fnmatch_lines(["rows: computed 12"])
    mine(GOOD, *keep).stdout.fnmatch_lines(["rows: reused 12 from *"])
    path.write_text("one = 2\n")
    what = "conftest" if "conftest" in changed else "weights_folder"
    mine(GOOD, *keep).stdout.fnmatch_lines(
        [f"rows: computed 12, not reused 12 of another program ({what} was *, now *)"]
    )


def test_folders_without_init_are_imported_from(mine, pytester):
    (pytester.path / "lib" / "sub").mkdir(parents=True)
    (pytester.path / "lib" / "sub" / "own.py").write_text("angle = 1\n")
    text = GOOD.replace("from tiny import *", "from tiny import *\nfrom lib.sub.own import angle")
    keep = ("--cpas-results=out", "-k", "test_sample")
    mine(text, *keep).stdout.fnmatch_lines(["rows: computed 12"])
    (pytester.path / "lib" / "sub" / "own.py").write_text("angle = 2\n")
    mine(text, *keep).stdout.fnmatch_lines(["rows: computed 12, not reused 12 *(code was *"])


DATA = """
import tiny

class Data(tiny.Tiny):
    name = "data"
"""

#: Every image is that of the first sample.
CONFUSED = (
    DATA
    + """
    def load(self, ref):
        sample, first = super().load(ref), super().load(self.samples[0])
        seen = tiny.replace(first.observation, category=ref.category)
        return tiny.replace(sample, observation=seen)
"""
)


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_rows_of_data_that_was_read_otherwise_are_not_believed(cpas, pytester, how):
    def run(data: str, *args: str) -> pytest.RunResult:
        pytester.makepyfile(lab_data=data)
        names = ("--cpas-method=tiny:Perfect", "--cpas-dataset=lab_data:Data")
        return pytester.runpytest_subprocess(*RUN, *names, "-k", "test_sample", *args)

    cpas("Perfect", "--collect-only")  # has tiny copied
    keep = ("--cpas-results=out", *how)
    run(DATA, *keep).stdout.fnmatch_lines(["rows: computed 12"])
    run(DATA, *keep).stdout.fnmatch_lines(["rows: reused 12 from *"])
    broken = run(CONFUSED, *keep)
    broken.stdout.fnmatch_lines(
        ["rows: computed 12, not reused 12 of another program (data_code was *, now *)"]
    )
    paths = sorted((pytester.path / "out").iterdir())
    kept = [read_results(path) for path in paths]
    assert [len(results.rows) for results in kept] == [12, 12]
    assert [*kept[0].rows.values()] != [*kept[1].rows.values()]


def test_rows_are_reused_on_purpose_only(mine):
    assert mine(GOOD, "--cpas-results=out").ret == 0
    broken = mine(BROKEN, "--cpas-results=out", "--cpas-results-reuse=any", "-k", "test_sample")
    assert broken.ret == 0
    broken.stdout.fnmatch_lines(["rows: reused 12 of another program from *"])


def test_merged_rows_are_told(mine, pytester):
    mine(GOOD, "--cpas-results=out")
    merged = pytester.runpytest_inprocess(*RUN, "--cpas-merge=out/mine-tiny.jsonl")
    merged.stdout.fnmatch_lines(["rows: merged 12"])


def test_two_runs_into_one_folder_at_once(cpas, pytester, request):
    """The second one is refused, whatever it is; the first loses nothing."""
    pytester.makepyfile(
        waits="""
        import time
        from pathlib import Path
        from tiny import *

        class Waits(Perfect):
            def predict(self, batch, seed):
                while not Path("go").exists():
                    time.sleep(0.01)
                return super().predict(batch, seed)
        """
    )
    names = ("--cpas-method=waits:Waits", "--cpas-dataset=tiny:Tiny", "--cpas-results=out")
    cpas("Perfect", "--collect-only")  # has tiny copied
    with (pytester.path / "log").open("wb") as log:
        first = subprocess.Popen(
            [sys.executable, "-m", "pytest", *RUN, *names], stdout=log, stderr=subprocess.STDOUT
        )
        request.addfinalizer(first.wait)
        request.addfinalizer(first.kill)
        path = pytester.path / "out" / "perfect-tiny.jsonl"
        deadline = time.monotonic() + 60
        while not (path.exists() and path.stat().st_size) and time.monotonic() < deadline:
            time.sleep(0.002)
        for seed in ("--cpas-seed=1", "--cpas-seed=0"):
            second = pytester.runpytest_subprocess(*RUN, *names, seed)
            assert second.ret in (pytest.ExitCode.USAGE_ERROR, pytest.ExitCode.INTERRUPTED)
            output = second.stdout.str() + second.stderr.str()
            assert "another run" in output
            assert "Traceback" not in output
        (pytester.path / "go").touch()
        assert first.wait() == 0, (pytester.path / "log").read_text()
    assert len(read_results(path).rows) == 12


def test_folder_that_is_deleted_ends_the_run(cpas, pytester):
    pytester.makepyfile(
        deleting="""
        import shutil
        from tiny import *

        class Deleting(Perfect):
            def predict(self, batch, seed):
                shutil.rmtree("out", ignore_errors=True)
                return super().predict(batch, seed)
        """
    )
    cpas("Perfect", "--collect-only")
    names = ("--cpas-method=deleting:Deleting", "--cpas-dataset=tiny:Tiny", "--cpas-results=out")
    result = pytester.runpytest_subprocess(*RUN, *names)
    assert result.ret == pytest.ExitCode.INTERRUPTED
    output = result.stdout.str() + result.stderr.str()
    assert "was removed or replaced while this run was writing it" in output
