"""Judge all stored predictions of a method on REAL275 under the default protocol, and under all.

    OMP_NUM_THREADS=1 python benchmarks/bench_protocols.py [dualposenet_real275.npz]

From the file to the tables: reading, facts, judgements. "All" are the protocols that ship and
apply; ``bop`` does not, as there are neither shapes nor cameras. In turns, three times each; the
ratio of the fastest must stay below 2.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from pytest_cpas.evaluation.predictions import StoredRun
from pytest_cpas.golden import RunTable
from pytest_cpas.protocols import PAPER, shipped_protocol, shipped_protocols


def seconds(path: Path, names: Sequence[str]) -> float:
    """How long the tables of a file under those protocols take."""
    start = time.perf_counter()
    run = StoredRun(path, protocols=[shipped_protocol(name) for name in names])
    table = RunTable.of(run, [run.judge(ref) for ref in run.samples])
    if not (table.table and table.scores):
        raise SystemExit("nothing was judged")
    return time.perf_counter() - start


def compare(path: Path) -> float:
    """The ratio, with what it is of."""
    every = [name for name in shipped_protocols() if name != "bop"]
    seconds(path, every)  # what is loaded at first use is loaded
    paper, whole = (
        min(times)
        for times in zip(
            *((seconds(path, [PAPER]), seconds(path, every)) for _ in range(3)), strict=True
        )
    )
    print(f"{PAPER}: {paper:.1f} s; {', '.join(every)}: {whole:.1f} s")
    return whole / paper


if __name__ == "__main__":
    data_folder = os.environ.get(
        "CPAS_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"
    )
    file = Path(data_folder, "predictions", "dualposenet_real275.npz")
    ratio = compare(Path(sys.argv[1]) if len(sys.argv) > 1 else file)
    print(f"ratio {ratio:.2f} (limit 2)")
    sys.exit(ratio > 2)
