"""Kill runs and writers at random moments: ``python tests/session/stress_kills.py [TRIALS]``.

A quarter of the trials are runs, the others updates of a golden table and writers of a results file
in turns, which are killed in the midst of it: the old table or the new one is there, and what is
kept of the rows is the beginning of what was written.

Every trial starts a run, alternately in one process and with two xdist workers, kills the
controller or a worker with SIGKILL at a random moment, and runs the same command until it is
through. The table and the recorded golden files must be those of a run that nobody disturbed.
"""

import itertools
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # when this is run as a script

from harness import RUN
from older_tables import record_older
from tables import GOLDEN, a_run, rows, table

from pytest_cpas.evaluation import ResultsFile, Shard, read_results
from pytest_cpas.golden import find_golden, record

SLOW = """
import time
from tiny import *

class Slow(Perfect):
    def predict(self, batch, seed):
        time.sleep(0.05)
        return super().predict(batch, seed)
"""


def command(folder: str, *args: str) -> list[str]:
    names = ("--cpas-method=slow:Slow", "--cpas-dataset=tiny:Tiny", "--snapshot-update")
    golden = (f"--cpas-golden={folder}/golden", f"--cpas-results={folder}/out")
    return [sys.executable, "-m", "pytest", *RUN, *names, *golden, *args]


def children(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def workers_of(pid: int) -> list[int]:
    """xdist's workers, whose controller is the child of the command that was started."""
    return [worker for controller in children(pid) for worker in children(controller)]


def outcome(folder: Path, output: str) -> tuple[list[str], dict[str, bytes]]:
    """The counts as printed, and the golden files. (Guards are printed in another way where a run
    that was killed had recorded them.)"""
    table = [line for line in output.splitlines() if re.search(r"\d/\d+ .* %| judged$", line)]
    files = {p.name: p.read_bytes() for p in (folder / "golden").rglob("*") if p.is_file()}
    return table, files


def until_through(folder: str, args: list[str]) -> str:
    for _ in range(5):
        done = subprocess.run(command(folder, *args), capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return done.stdout
    raise SystemExit(f"{folder}: five runs did not end well:\n{done.stdout}")


def writer(kind: str, folder: Path, started: Path) -> None:
    """Update or write for ever."""
    started.touch()
    for turn in itertools.count():
        if kind == "golden":
            record(folder, table(s_03=9) if turn % 2 else GOLDEN)
            continue
        shutil.rmtree(folder / "out", ignore_errors=True)
        with ResultsFile(folder / "out", a_run(), Shard(1, 1)) as file:
            for row in rows():
                file.add(row)


def kill_writer(kind: str, root: Path, rng: random.Random) -> str:
    """Kill one, and see what is left; returns it in a word."""
    folder = root / f"{kind}-{rng.random()}"
    folder.mkdir()
    started = folder / "started"
    older = kind == "golden" and rng.random() < 0.5
    record_older(folder, GOLDEN) if older else record(folder, GOLDEN)
    before = find_golden(folder, "m", "d")
    child = os.fork()
    if child == 0:
        writer(kind, folder, started)
        os._exit(1)
    while not started.exists():
        time.sleep(0.001)
    time.sleep(rng.uniform(0, 0.05))
    os.kill(child, signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    if kind == "golden":
        survivor = find_golden(folder, "m", "d")
        assert survivor in (before, GOLDEN, table(s_03=9))
        # what the killed update left is of no account to a reader, and the next update removes it
        record(folder, GOLDEN)
        left = {path.name for path in (folder / "recorded" / "m" / "d").iterdir()}
        assert left == {"run.toml", "facts.csv", "cpas.toml"}, left
        assert find_golden(folder, "m", "d") == GOLDEN
        if survivor.outdated:
            return "table of version 1"
        return "old table" if survivor == GOLDEN else "new table"
    path = folder / "out" / "m-d.jsonl"
    file = ResultsFile(folder / "out", a_run(), Shard(1, 1))
    kept = list(file.rows.values())
    assert kept == rows()[: len(kept)]
    with file:
        for row in rows()[len(kept) :]:
            file.add(row)
    assert list(read_results(path).rows.values()) == rows()
    return f"{len(kept)} rows"


def kill_writers(trials: int) -> None:
    rng = random.Random(trials)
    root = Path(tempfile.mkdtemp(prefix="writers-"))
    left = Counter(
        kill_writer(("golden", "results")[trial % 2], root, rng) for trial in range(trials)
    )
    shutil.rmtree(root)
    print(f"{trials} writers, killed in the midst of it; left were {dict(sorted(left.items()))}")


def kill_runs(trials: int) -> None:
    rng = random.Random(trials)
    root = Path(tempfile.mkdtemp(prefix="kills-"))
    os.chdir(root)
    shutil.copy(Path(__file__).parents[1] / "tiny.py", root)
    (root / "slow.py").write_text(SLOW)
    started = time.monotonic()
    expected = outcome(root / "whole", until_through("whole", []))
    duration = time.monotonic() - started
    killed = {"controller": 0, "worker": 0, "nobody: it was through": 0}
    for trial in range(trials):
        args = ["-n2"] if trial % 2 else []
        folder = f"trial-{trial}"
        process = subprocess.Popen(
            command(folder, *args), stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        time.sleep(rng.uniform(0.3, 0.9) * duration * (2 if args else 1))
        victim = "controller"
        if process.poll() is not None:
            victim = "nobody: it was through"
        elif (workers := workers_of(process.pid)) and rng.random() < 0.7:
            victim = "worker"
            os.kill(rng.choice(workers), signal.SIGKILL)
            process.communicate()  # the controller goes on with another worker
        else:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
        killed[victim] += 1
        assert outcome(root / folder, until_through(folder, args)) == expected, folder
    shutil.rmtree(root)
    print(f"{trials} runs, killed: {killed}; every one ended with the same table and golden files")


if __name__ == "__main__":
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    kill_writers(count - count // 4)
    kill_runs(count // 4)
