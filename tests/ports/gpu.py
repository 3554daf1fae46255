"""All that a GPU is needed for, in a few minutes: ``python tests/ports/gpu.py``, or ``nox -s gpu``.

Every port, with seeded weights and in full precision, deterministically: how far its answers are
from those on the CPU, of a batch from those one by one, and of the same call again, which must be
the same; its contract on the device; and what network and prediction take, beside the goals, which
are those of one H100. Ends with an error if a check fails. A goal that is missed is told, no more.
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# before torch: cuBLAS gives the same sums from run to run
os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")

import cases
import icaps_cases
import numpy as np
import plausible
import torch
from scipy.spatial.transform import Rotation

from method_adapters._networks.icaps_matching import ROTATIONS
from method_adapters.asmnet import AsmNet
from method_adapters.icaps import ICaps
from method_adapters.sdfest import Sdfest
from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.types import (
    CATEGORIES,
    GroundTruth,
    Observation,
    Pose,
    Prediction,
    Sample,
    SampleRef,
    Symmetry,
)

METHODS: dict[str, Any] = {**cases.METHODS, "asmnet": AsmNet, "sdfest": Sdfest, "icaps": ICaps}
#: Milliseconds per object at most, by port, what is timed and batch.
GOALS = {
    ("sgpa", "network", 1): 15,
    ("dpdn", "network", 1): 15,
    ("rbppose", "network", 1): 6,
    ("icaps", "network", 1): 30,
    ("spd", "predict", 16): 8,
    ("crnet", "predict", 16): 8,
    ("sgpa", "predict", 16): 8,
    ("cass", "predict", 16): 8,
    ("dpdn", "predict", 16): 40,
    ("rbppose", "predict", 16): 3,
    ("sdfest", "predict", 8): 150,
    ("icaps", "predict", 1): 1000,
}
#: Of the contract, what is checked of iCaps, which takes about a second for an answer.
FEW_CHECKS = ("repeatable", "batch")
SEED = 3


def observations(name: str, count: int) -> list[Observation]:
    """Balls of one size in different places, of the categories that the port knows in turns."""
    known = [c for c in CATEGORIES if c in METHODS[name].info.categories]
    radius = 60 if name == "rbppose" else 34
    return [
        cases.observation(known[i % len(known)], (120 + 25.3 * i, 140 + 12.7 * i), radius + i % 3)
        for i in range(count)
    ]


def apart(a: Sequence[Prediction], b: Sequence[Prediction]) -> tuple[float, float]:
    """How far answers are from each other at most, degrees and millimetres; infinitely where one of
    them is none."""
    worst = np.zeros(2)
    for x, y in zip(a, b, strict=True):
        if len(x.hypotheses) != len(y.hypotheses):
            return np.inf, np.inf
        for p, q in zip(x.hypotheses, y.hypotheses, strict=True):
            turn = Rotation.from_matrix(p.rotation.T @ q.rotation).magnitude()
            shift = np.linalg.norm(p.translation - q.translation)
            worst = np.maximum(worst, [np.degrees(turn), 1000 * shift])
    return float(worst[0]), float(worst[1])


def same(a: Sequence[Prediction], b: Sequence[Prediction]) -> bool:
    """To the last bit, in everything."""
    return all(
        np.array_equal(getattr(p, part), getattr(q, part))
        for x, y in zip(a, b, strict=True)
        for p, q in zip(x.hypotheses, y.hypotheses, strict=True)
        for part in ("rotation", "translation", "extents")
    )


def network_of(method: Any, name: str, seen: Sequence[Observation]) -> Callable[[], object] | None:
    """The network's share of a prediction, with copies to and from the device; SDFEst has none that
    takes a batch."""
    if name == "sdfest":
        return None
    if name == "icaps":
        _, refiner = method._category(seen[0].category)
        points = np.random.RandomState(0).uniform(-1, 1, (4873, 3)).astype(np.float32)
        coordinates = torch.from_numpy(points).to(method._device)
        return lambda: refiner.shape_of(coordinates).distances(coordinates[:1]).cpu()
    made = [method.prepare(x, np.random.default_rng(SEED)) for x in seen]
    if name == "asmnet":
        points = np.stack([x.points for x in made])
        return lambda: method._run[seen[0].category](points)
    alike = [x for x in made if all(p.shape == q.shape for p, q in zip(x, made[0], strict=True))]
    alike = (alike * len(made))[: len(made)]  # CASS's images differ in size
    stacked = [np.stack(part) for part in zip(*alike, strict=True)]
    return lambda: method._run(*stacked)


def milliseconds(function: Callable[[], object], objects: int, device: str, repeats: int) -> float:
    """Per object, the median, after what is done once: the first calls capture graphs."""
    times = []
    for i in range(3 + repeats):
        start = time.perf_counter()
        function()
        if device.startswith("cuda"):
            torch.cuda.synchronize()
        if i >= 3:
            times.append(1000 * (time.perf_counter() - start) / objects)
    return statistics.median(times)


class Table:
    """Rows as they are measured, each printed at once; and what failed."""

    def __init__(self) -> None:
        self.failed: list[str] = []

    def row(self, name: str, what: str, figure: str, limit: str, good: bool | None) -> None:
        word = {True: "", False: "FAILED", None: "missed"}[good]
        print(f"{name:8} {what:22} {figure:>20} {limit:>22} {word}".rstrip(), flush=True)
        if good is False:
            self.failed.append(f"{name}: {what}")

    def distance(self, name: str, what: str, found: tuple[float, float], tolerance: float) -> None:
        limits = np.degrees(tolerance), 1000 * tolerance
        figure, limit = (f"{deg:.2g} deg, {mm:.2g} mm" for deg, mm in (found, limits))
        self.row(name, what, figure, limit, all(x <= y for x, y in zip(found, limits, strict=True)))

    def time(self, name: str, what: str, batch: int, found: float) -> None:
        goal = GOALS.get((name, what, batch))
        told = "" if goal is None else f"goal {goal} ms"
        good = None if goal is not None and found > goal else True
        self.row(name, f"{what}, batch {batch}", f"{found:.2f} ms", told, good)


def check_port(name: str, folder: Path, asked: argparse.Namespace, table: Table) -> None:
    """All of one port."""

    def loaded(device: str) -> Any:
        method = METHODS[name]()
        method.load(folder, device)
        if asked.iterations is not None and name == "sdfest":
            method.iterations = asked.iterations
        return method

    method = loaded(asked.device)
    most = {"sdfest": min(8, asked.batch), "icaps": 1}.get(name, asked.batch)
    seen = observations(name, most)
    few = seen[: min(2, most)]
    together = method.predict(seen, SEED)
    tolerance = method.info.tolerance
    table.distance(
        name,
        "CPU and device",
        apart(loaded("cpu").predict(few, SEED), together[: len(few)]),
        tolerance,
    )
    single = [method.predict([x], SEED)[0] for x in seen]
    table.distance(name, f"batch of {most} and of 1", apart(single, together), tolerance)
    # the plain way, the one that is captured, and one that is replayed
    again = [method.predict(seen, SEED) for _ in range(2)]
    table.row(name, "same seed again", "", "the same", all(same(together, x) for x in again))
    truth = GroundTruth(
        pose=Pose(np.eye(3), np.array([0, 0, 0.8])),
        extents=np.full(3, 0.1),
        symmetry=Symmetry.full(),
    )
    samples = [
        Sample(SampleRef(id=str(i), category=x.category, scene="0"), x, truth)
        for i, x in enumerate(observations(name, 2))
    ]
    subject = MethodSubject(method, samples, seed=1, fresh=lambda: loaded(asked.device))
    for check_name, check in CONTRACT.items():
        if name == "icaps" and check_name not in FEW_CHECKS:
            continue
        if check.demanded(method.info) and check.applies(method.info):
            result = check_contract(subject, check)
            if result.violated:
                table.row(name, f"contract: {check_name}", "", result.message, False)
    for batch in dict.fromkeys((1, most)):
        part = seen[:batch]
        network = network_of(method, name, part)
        if network is not None:
            found = milliseconds(network, batch, asked.device, asked.repeats)
            table.time(name, "network", batch, found)
        found = milliseconds(
            lambda part=part: method.predict(part, SEED), batch, asked.device, asked.repeats
        )
        table.time(name, "predict", batch, found)


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--ports", default=",".join(METHODS))
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--iterations", type=int, help="of SDFEst's refinement")
    parser.add_argument("--rotations", type=int, default=ROTATIONS, help="of iCaps' codebook")
    asked = parser.parse_args(arguments)
    if asked.device.startswith("cuda") and not torch.cuda.is_available():
        print(
            f"torch {torch.__version__} sees no GPU: nothing was checked. Where there is one, in an"
            " environment with torch for it: python tests/ports/gpu.py; --device cpu tries the"
            " script without"
        )
        return 2
    torch.use_deterministic_algorithms(True)
    torch.utils.deterministic.fill_uninitialized_memory = False  # that is for finding mistakes
    torch.set_float32_matmul_precision("highest")
    torch.backends.cudnn.allow_tf32 = False
    begin, table = time.monotonic(), Table()
    on = torch.cuda.get_device_name() if asked.device.startswith("cuda") else "the CPU"
    print(f"{on}, torch {torch.__version__}, CUDA {torch.version.cuda}, full precision")
    print(f"{'port':8} {'what':22} {'found':>20} {'limit':>22}")
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        names = asked.ports.split(",")
        plausible.write_assets(folder, names)
        if "icaps" in names:
            icaps_cases.write_assets(folder, asked.rotations)
        for name in names:
            check_port(name, folder, asked, table)
    print(f"{time.monotonic() - begin:.0f} s; failed: {', '.join(table.failed) or 'nothing'}")
    return 1 if table.failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
