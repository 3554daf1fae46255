"""What the harness itself costs: collection, time per sample, memory of the controller.

A data set without images and a method without a model; the peer is pytest with as many empty
parametrised tests. ``python benchmarks/bench_harness.py [SAMPLES] [ROWS]``; the second number is
for the memory of a controller that gets its rows from workers, a scene per item, as a run of that
size would. Should be: 2 ms per sample, 6 s to collect 16118 samples, 500 MiB for 300000 rows.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

MODULE = """
import numpy as np
from pytest_cpas.types import *

# the box fills the image, as a method's contract wants it
CAMERA = Camera(8, 6, 60.0, 60.0, 3.5, 2.5)
EXTENTS = np.array([0.12, 0.09, 0.1])
DEPTH = np.ones((6, 8), np.float32)
OBSERVATION = Observation("mug", np.zeros((6, 8, 3), np.float32), DEPTH, DEPTH > 0, CAMERA)
TRUTH = GroundTruth(Pose(np.eye(3), [0, 0, 1]), EXTENTS, Symmetry.none())

class Empty(Dataset):
    name, digest, missing, damaged = "empty", "1", (), ()

    def __init__(self, data_dir):
        count = int((data_dir / "count").read_text())
        self.samples = [
            SampleRef(f"scene_{i // 100}/{i:06d}", "mug", f"scene_{i // 100}") for i in range(count)
        ]

    def load(self, ref):
        return Sample(ref, OBSERVATION, TRUTH)

class Nothing:
    info = MethodInfo("nothing", ("mug",), frozenset(), frozenset({"extents"}), "MIT")

    def load(self, assets, device):
        pass

    def predict(self, batch, seed):
        return [Prediction((Hypothesis(np.eye(3), [0, 0.01, 1], EXTENTS),)) for _ in batch]
"""

PEER = """
import pathlib, pytest
COUNT = int(pathlib.Path(__file__).with_name("count").read_text())

@pytest.mark.parametrize("i", range(COUNT))
def test_nothing(i):
    pass
"""

# peak memory of this process, and when collection and the run ended
CONFTEST = """
import json, resource, time
START, CPU = time.perf_counter(), time.process_time()
TIMES = {}

def pytest_collection_finish(session):
    TIMES["collection_s"] = time.process_time() - CPU

def pytest_unconfigure(config):
    if not hasattr(config, "workerinput"):
        TIMES["whole_s"] = time.perf_counter() - START
        TIMES["cpu_s"] = time.process_time() - CPU
        TIMES["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        config.rootpath.joinpath("times.json").write_text(json.dumps(TIMES))
"""


def run(folder: Path, count: int, *args: str) -> dict[str, float]:
    (folder / "count").write_text(str(count))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:dash", "-p", "no:cacheprovider"]
    command += ["--tb=no", "--no-header", *args]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stdout[-3000:] + done.stderr[-3000:])
    times: dict[str, float] = json.loads((folder / "times.json").read_text())
    return times


def main(samples: int, rows: int) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "empty.py").write_text(MODULE)
        (folder / "test_peer.py").write_text(PEER)
        (folder / "conftest.py").write_text(CONFTEST)
        (folder / "pytest.ini").write_text("[pytest]")
        names = ("--cpas-method=empty:Nothing", "--cpas-dataset=empty:Empty", "--cpas-data=.")
        run(folder, 100, *names, "--snapshot-update")  # warms caches
        peer = run(folder, samples, "test_peer.py")
        ours = run(folder, samples, *names, "--snapshot-update")
        again = run(folder, samples, *names, "--cpas-require-golden", "--cpas-results=out")
        for title, times in (
            ("pytest, empty tests", peer),
            ("recording", ours),
            ("comparing, rows kept on disk", again),
        ):
            per_sample = 1000 * (times["cpu_s"] - times["collection_s"]) / samples
            print(
                f"{title:30} {samples} samples: collection {times['collection_s']:6.2f} s, then"
                f" {per_sample:.2f} ms per sample (CPU), whole {times['whole_s']:7.1f} s"
                f" ({times['cpu_s'] / peer['cpu_s']:.2f} of pytest's CPU time),"
                f" peak {times['peak_mib']:.0f} MiB"
            )
        large = ("-n2", "--cpas-granularity=scene", "--cpas-golden=large")
        for title, end in (
            ("recording", "--snapshot-update"),
            ("comparing", "--cpas-require-golden"),
        ):
            times = run(folder, rows, *names, *large, end)
            print(
                f"controller of 2 workers, {title}, {rows} rows:"
                f" {1000 * times['cpu_s'] / rows:.3f} ms per row (CPU), peak"
                f" {times['peak_mib']:.0f} MiB"
            )


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:3] or ("16118", "300000")))
