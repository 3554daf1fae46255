"""``pytest-cpas noise``: how far other platforms move the facts of a golden table's samples.

One machine stands for several: what multiplies matrices and which instructions of the processor are
used can be chosen before a process starts. Runs of other machines are taken as they are, from their
results files.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from pytest_cpas.evaluation import ResultsError, kernels, merge
from pytest_cpas.golden import (
    GoldenError,
    Noise,
    RunTable,
    keep_noise,
    other_conditions,
    read_golden,
)

__all__ = ["learn_noise", "measured_runs", "settings"]

#: What of a program must be the same: what moves otherwise is no platform.
_PROGRAM = ("code", "data_code")

#: Kernels of OpenBLAS that every processor of these machines runs.
_KERNELS = {
    "x86_64": ("Sandybridge", "Nehalem"),
    "amd64": ("Sandybridge", "Nehalem"),
    "aarch64": ("ARMV8",),
}


def settings() -> list[dict[str, str]]:
    """Variables of the environment that stand for other platforms: other kernels for linear
    algebra, older instructions, and both."""
    others = [k for k in _KERNELS.get(platform.machine().lower(), ()) if k not in kernels()]
    algebra = {"OPENBLAS_CORETYPE": others[0]} if others else {}
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    instructions = {"NPY_DISABLE_CPU_FEATURES": " ".join(found)} if found else {}
    if importlib.util.find_spec("torch"):
        instructions["ATEN_CPU_CAPABILITY"] = "default"
    if importlib.util.find_spec("numba"):
        instructions["NUMBA_CPU_NAME"] = "generic"
    both = algebra | instructions
    return [each for each in (algebra, instructions) if each and each != both] + [both]


def measured_runs(arguments: Sequence[str], folder: Path) -> Iterator[tuple[str, list[Path]]]:
    """Run pytest with ``arguments`` under each of :func:`settings`: in words, and its results files
    in ``folder``. Raises :class:`GoldenError` for a run that gives none."""
    for number, setting in enumerate(settings()):
        words, to = " ".join(f"{k}={v}" for k, v in setting.items()), folder / str(number)
        run = subprocess.run(  # noqa: S603 - this Python, with what the user asks for
            [sys.executable, "-m", "pytest", *arguments, f"--cpas-results={to}"],
            env={**os.environ, **setting},
            capture_output=True,
            check=False,
        )
        files = sorted(to.glob("*.jsonl"))
        # 1: against the golden table something flipped, which is what is looked for
        if run.returncode not in (0, 1) or not files:
            told = run.stdout.decode("utf-8", "replace").strip().splitlines()[-5:]
            raise GoldenError(f"pytest under {words} gave no results: {' / '.join(told)}")
        yield words, files


def check_golden(golden: Path) -> None:
    """Raise :class:`GoldenError` if there is no table that noise could be kept with."""
    if not any(golden.glob("recorded/*/*")):
        raise GoldenError(
            f"{golden}: no golden tables there; record one first, or name the folder with --golden"
        )


def learn_noise(golden: Path, runs: Mapping[str, Sequence[Path]]) -> list[str]:
    """Compare results files, by platform in words, with the golden tables below ``golden``, and
    keep in each table how far facts moved; lines on that.

    Raises :class:`GoldenError` for results of another program or other conditions, or of a part.
    """
    tables: dict[tuple[str, str], dict[str, RunTable]] = {}
    for where, files in runs.items():
        try:
            merged = [run for file in files for run in merge([file])]
        except ResultsError as error:
            raise GoldenError(str(error)) from error
        for run in merged:
            made = RunTable.of(run)
            tables.setdefault((made.method, made.dataset), {})[where] = made
    lines = []
    for (method, dataset), measured in tables.items():

        def measure(table: RunTable, measured: Mapping[str, RunTable] = measured) -> Noise:
            for where, run in measured.items():
                _check_comparable(table, run, where)
            first = {name: sample.facts for name, sample in table.samples.items()}
            return Noise.measured(
                first,
                {
                    where: {name: sample.facts for name, sample in run.samples.items()}
                    for where, run in measured.items()
                },
            )

        folder = keep_noise(golden, method, dataset, measure)
        lines.append(f"{folder}: measured on {len(measured)} platforms")
        lines += read_golden(folder).noise.told()
    return lines


def _check_comparable(golden: RunTable, run: RunTable, platform_words: str) -> None:
    where = f"{run.method} on {run.dataset} ({platform_words})"
    if told := other_conditions(golden, run):
        raise GoldenError(f"{where}: made under other conditions: {'; '.join(told)}")
    for category in sorted(golden.listed):
        then = golden.provenance_of(category)
        for key in _PROGRAM:
            if then.get(key) != run.provenance.get(key):
                raise GoldenError(
                    f"{where}: {key} of {category} was {then.get(key, 'not recorded')}, now"
                    f" {run.provenance.get(key, 'not given')}: what moves may be the program;"
                    " record the table anew first (--snapshot-update)"
                )
    if run.provenance.get("deterministic") == "no":
        raise GoldenError(
            f"{where}: {run.method} declares that it varies by itself; record several"
            " seeds (--cpas-jitter), which say how far"
        )
    if missing := golden.samples.keys() - run.samples.keys():
        raise GoldenError(f"{where}: {len(missing)} samples of the golden table are not there")
