"""What a method costs more behind a worker than in this process.

A sample of 640 x 480 with colour, depth and mask goes to a worker of this interpreter and its
answer comes back; the same method answers here in turns with it.
``python benchmarks/bench_remote.py [SAMPLES]``. Should be: under 4 ms of overhead per sample
(median, processor time of both sides), a start under 0.3 s besides what the interpreter and numpy
take to be there.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from pytest_cpas.remote import Spec, remote_method
from pytest_cpas.types import Camera, Hypothesis, MethodInfo, Observation, Prediction

METHOD = """
import numpy as np


class Plain:
    info = {
        "name": "plain",
        "categories": ["mug"],
        "needs": ["rgb", "depth"],
        "gives": ["extents", "shape"],
        "licence": "MIT",
    }
    points = np.random.RandomState(0).uniform(-0.05, 0.05, (1024, 3))

    def load(self, assets, device):
        pass

    def predict(self, batch, seed):
        return [
            {
                "rotation": np.eye(3),
                "translation": [0, 0, float(seen["depth"][seen["mask"]].mean())],
                "extents": [0.1, 0.1, 0.1],
                "points": self.points,
            }
            for seen in batch
        ]
"""


class Here:
    """The same, here."""

    info = MethodInfo(
        name="plain",
        categories=("mug",),
        needs=frozenset({"rgb", "depth"}),
        gives=frozenset({"extents", "shape"}),
        licence="MIT",
    )
    points = np.random.RandomState(0).uniform(-0.05, 0.05, (1024, 3))

    def load(self, assets, device):
        pass

    def predict(self, batch, seed):
        return [
            Prediction(
                (
                    Hypothesis(
                        rotation=np.eye(3),
                        translation=[0, 0, float(seen.depth[seen.mask].mean())],
                        extents=[0.1, 0.1, 0.1],
                        points=self.points,
                    ),
                )
            )
            for seen in batch
        ]


def observation() -> Observation:
    dice = np.random.default_rng(0)
    mask = np.zeros((480, 640), bool)
    mask[200:300, 250:350] = True
    return Observation(
        category="mug",
        rgb=dice.random((480, 640, 3), np.float32),
        depth=dice.random((480, 640), np.float32) + np.float32(0.5),
        mask=mask,
        camera=Camera(640, 480, 577.5, 577.5, 319.5, 239.5),
    )


def worker_seconds(pid: int) -> float:
    """Processor time of the worker's only thread; Linux."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9


def seconds_of(method, seen, pid) -> tuple[float, float]:
    """Processor time of both sides, and the wall clock."""
    batch = [seen.copy()]
    start, other, wall = time.process_time(), worker_seconds(pid), time.perf_counter()
    method.predict(batch, 0)
    wall = time.perf_counter() - wall
    return time.process_time() - start + worker_seconds(pid) - other, wall


def start_seconds(folder: Path) -> tuple[float, float]:
    """Seconds until a worker has loaded its class, and those of an interpreter with numpy."""
    began = time.perf_counter()
    kind = remote_method(spec(folder))
    started = time.perf_counter() - began
    kind.remote.close()
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import numpy"], check=True)
    return started, time.perf_counter() - began


def spec(folder: Path) -> Spec:
    return Spec(command=(sys.executable,), cls="plain_method:Plain", path=(str(folder),))


def main(samples: int) -> int:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "plain_method.py").write_text(METHOD)
        starts = [start_seconds(folder) for _ in range(9)]
        kind = remote_method(spec(folder))
        there, here = kind(), Here()
        for method in (there, here):
            method.load(None, "cpu")
        pid, seen = kind.remote.hello["pid"], observation()
        pairs = [
            (seconds_of(there, seen, pid), seconds_of(here, seen, pid)) for _ in range(samples)
        ]
        kind.remote.close()
    overhead = statistics.median(a[0] - b[0] for a, b in pairs)
    wall = statistics.median(a[1] - b[1] for a, b in pairs)
    start = statistics.median(a - b for a, b in starts)
    told = {
        "overhead_ms": round(1e3 * overhead, 2),
        "overhead_wall_ms": round(1e3 * wall, 2),
        "start_ms": round(1e3 * start),
        "samples": samples,
    }
    print(json.dumps(told))
    return int(overhead > 4e-3 or start > 0.3)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if sys.argv[1:] else 200))
