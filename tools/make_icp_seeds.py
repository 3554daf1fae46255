"""Make ``tests/golden/icp_seeds.csv`` and ``icp_facts.npz``: what ``icp`` gives under many seeds.

The baseline is deterministic but for the points that it draws; here every seed also adds noise to
the depth, as a sensor would. The verdict on jitter is measured with these answers. One process for
some quarter of an hour, and half an hour for the facts; from the project's root::

    python tools/make_icp_seeds.py
"""

from __future__ import annotations

import csv
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from method_adapters.icp import Icp
from pytest_cpas.datasets.perturbed import noisy_depth
from pytest_cpas.datasets.synthetic import SyntheticHandheld
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.protocols import PAPER, judge_outcomes, shipped_protocol, shipped_protocols
from pytest_cpas.types import Observation, Prediction

PATH = Path(__file__).parents[1] / "tests" / "golden" / "icp_seeds.csv"
FACTS = PATH.with_name("icp_facts.npz")
SEEDS = 40
#: The first seed whose facts are kept, and of how many of the samples: 14 of each category.
FIRST, SAMPLES = 100, 84
#: Standard deviation of the depth at 1 m, metres.
NOISE = 0.005


class NoisyIcp(Icp):
    """``icp`` on observations whose depth has noise, which the seed and the mask draw."""

    def predict(self, batch: Sequence[Observation], seed: int) -> list[Prediction]:
        noisy = []
        for observation in batch:
            drawn = np.random.default_rng([seed, zlib.crc32(observation.mask.tobytes())])
            noisy.append(noisy_depth(observation, NOISE, drawn))
        return super().predict(noisy, seed)


def make_facts() -> None:
    """All facts that the protocols which ship need of samples, by name: (samples, seeds), rounded
    to 11 binary digits; ``samples`` and ``categories`` name them."""
    protocols = [shipped_protocol(name) for name in shipped_protocols()]
    run = MethodRun(
        NoisyIcp(), SyntheticHandheld(None), seed=FIRST, seeds=SEEDS, protocols=protocols
    )
    rows = [run.judge(ref) for ref in run.samples[:SAMPLES]]
    facts = {
        name: np.array([[answer.facts[name] for answer in row.answers] for row in rows], np.float16)
        for name in run.facts
    }
    names, categories = zip(*((row.sample, row.category) for row in rows), strict=True)
    np.savez_compressed(FACTS, samples=names, categories=categories, **facts)


def make_outcomes() -> None:
    """One line per sample: its category, and per seed the outcome in hexadecimal (1111: f).

    Of the default protocol's columns that are read, those that only guard left out.

    Samples that are there are kept, so that it goes on where it was interrupted.
    """
    columns = [column for column in shipped_protocol(PAPER).counts if not column.guard]
    run = MethodRun(NoisyIcp(), SyntheticHandheld(None), seeds=SEEDS)
    text = PATH.read_text(encoding="utf-8") if PATH.exists() else "sample,category,seeds\n"
    known = {line.partition(",")[0] for line in text.splitlines()}
    with PATH.open("w", newline="", encoding="utf-8") as file:
        file.write(text)
        writer = csv.writer(file, lineterminator="\n")
        for ref in run.samples:
            if ref.id in known:
                continue
            answers = run.judge(ref).answers
            told = judge_outcomes(columns, [answer.facts for answer in answers])
            digits = "".join(f"{int(outcome, 2):x}" for outcome in told)
            writer.writerow((ref.id, ref.category, digits))
            file.flush()


if __name__ == "__main__":
    make_outcomes()
    if not FACTS.exists():
        make_facts()
