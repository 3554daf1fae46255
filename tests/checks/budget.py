"""How sure is a planted fault to be caught? A table: fault, property, share of seeds.

What a property's corners show is caught whatever the seed is, and tried once. What is drawn is
tried with many seeds, at the default number of examples; a fault that is not caught with each of
them fails the run: enumerate what shows it, or mend its strategy::

    python tests/checks/budget.py --tries 300 --processes 2
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import faults

from pytest_cpas.checks.metrics import PROPERTIES, check
from pytest_cpas.checks.outcome import Outcome


@dataclass(frozen=True)
class Budget:
    """Of a fault: ``by`` which property with how many of ``tries`` seeds, and by any of them.

    ``tries`` is 1 of what corners show.
    """

    label: str
    by: str
    share: int
    any_share: int
    tries: int


def budget(index: int, tries: int) -> Budget:
    """Of the fault with this index in the catalogue."""
    planted = faults.FAULTS[index]
    subject, label = planted.subject(), f"{planted.metric}: {planted.name}"
    names = faults.properties_of(planted.metric)
    caught: Counter[str] = Counter()
    for name in names:
        result = check(subject, PROPERTIES[name], shrink=False)
        if result.outcome is not Outcome.PASSED:
            caught[name] += 1
            if result.examples <= sum(1 for _ in PROPERTIES[name].corners()):
                return Budget(label, name, 1, 1, 1)
    together = bool(caught)
    for seed in range(1, tries):
        # the likeliest first: one that catches it is enough
        found = False
        for name in [n for n, _ in caught.most_common()] or names:
            result = check(subject, PROPERTIES[name], seed=seed, shrink=False)
            if result.outcome is not Outcome.PASSED:
                caught[name] += 1
                found = True
                break
        together += found
    by, share = caught.most_common(1)[0] if caught else ("-", 0)
    return Budget(label, by, share, together, tries)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tries", type=int, default=300, help="seeds 0 to N - 1")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--only", default="", help="faults with this in metric or name")
    options = parser.parse_args()
    chosen = [i for i, f in enumerate(faults.FAULTS) if options.only in f"{f.metric}: {f.name}"]
    missed, enumerated = [], 0
    with ProcessPoolExecutor(options.processes) as pool:
        for row in pool.map(budget, chosen, [options.tries] * len(chosen)):
            enumerated += row.tries == 1
            told = "enumerated" if row.tries == 1 else f"{row.any_share} of {row.tries}"
            print(f"{told}\t{row.label}\t{row.by} ({row.share})", flush=True)
            if row.any_share < row.tries:
                missed.append(row.label)
    print(f"\n{len(chosen)} faults: {enumerated} by corners, {len(missed)} not with every seed")
    for label in missed:
        print(f"    {label}")
    return bool(missed)


if __name__ == "__main__":
    sys.exit(main())
