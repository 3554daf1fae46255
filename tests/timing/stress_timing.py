"""Find a planted slow-down on a busy machine: ``python tests/timing/stress_timing.py [TRIALS]``.

While a loop keeps one core busy, a method that does 30 % more work than another is timed against
it, and against its own ratio to the calibration kernel as recorded before the slow-down, with
--cpas-benchmark-fail=20%; and so is a method that does as much work. The second may fail in no
trial. The first has to fail in every one; against the record UNDECIDED is counted, but no error:
method and kernel do not suffer from other jobs alike, and the record is of another moment.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # when this is run as a script

from harness import RUN

WORKING = """
import numpy as np
from tiny import *

VALUES = np.random.default_rng(1).random(20_000)
MATRIX = np.random.default_rng(2).standard_normal((64, 64)) / 8

class Works(Perfect):
    units = 10

    def predict(self, batch, seed):
        for observation in batch:
            # samples differ, as those of a method do
            for _ in range(self.units * (4 + round(float(observation.rgb[0, 0, 0]) * 255) % 5)):
                product = MATRIX
                for _ in range(4):
                    product = product @ MATRIX
                np.sin(VALUES).sum()
                sum(number * number for number in range(1000))
        return super().predict(batch, seed)

class Same(Works):
    pass

class Slow(Works):
    units = 13
"""

BUSY = "while True: pass"

#: What is timed, against what, and how that has to end.
CASES = {
    "slower than another": ("Slow", "--cpas-benchmark-against=working:Works", 1),
    "like another": ("Same", "--cpas-benchmark-against=working:Works", 0),
    "slower than recorded": ("Slow", "--cpas-golden=golden", 1),
    "like recorded": ("Same", "--cpas-golden=golden", 0),
}


def run(folder: Path, method: str, *args: str) -> tuple[int, dict]:
    """The exit code, and what the report holds below ``speed``."""
    names = (f"--cpas-method=working:{method}", "--cpas-dataset=tiny:Tiny", "--cpas-benchmark")
    command = [sys.executable, "-m", "pytest", *RUN, *names, "-k=test_speed", "--cpas-report=out"]
    done = subprocess.run(
        [*command, *args], cwd=folder, capture_output=True, text=True, check=False
    )
    speed = json.loads((folder / "out" / "report.json").read_text())["runs"][0]["speed"]
    if speed is None:
        raise SystemExit(done.stdout[-3000:] + done.stderr[-3000:])
    return done.returncode, speed


def main(trials: int) -> None:
    failed = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(Path(__file__).parents[1] / "tiny.py", folder)
        (folder / "working.py").write_text(WORKING)
        (folder / "pytest.ini").write_text("[pytest]")
        busy = subprocess.Popen([sys.executable, "-c", BUSY])
        try:
            code, _ = run(folder, "Works", "--snapshot-update")
            if code:
                raise SystemExit("the ratio could not be recorded")
            for title, (method, how, expected) in CASES.items():
                words: Counter[str] = Counter()
                slowdowns, quadruples, right = [], [], 0
                start = time.perf_counter()
                for _ in range(trials):
                    code, speed = run(folder, method, how, "--cpas-benchmark-fail=20%")
                    word = speed["verdict"]["word"]
                    right += code == expected
                    unsure = "recorded" in title and word == "UNDECIDED"
                    failed += code != expected and not unsure
                    words[word] += 1
                    slowdowns.append(speed["slowdown"]["median"])
                    quadruples.append(speed["rounds"] // 2)
                print(
                    f"{title:20} {right} of {trials} as it has to be ({dict(words)}); slow-downs"
                    f" {min(slowdowns):.3f} to {max(slowdowns):.3f},"
                    f" {sum(quadruples) / trials:.0f} quadruples and"
                    f" {(time.perf_counter() - start) / trials:.0f} s on average; load average"
                    f" {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores",
                    flush=True,
                )
        finally:
            busy.kill()
            busy.wait()
    if failed:
        raise SystemExit(f"{failed} trials went wrong")


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 20)
