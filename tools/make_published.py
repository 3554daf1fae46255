"""Make golden/published/ from the paper's printed figures: ``make_published.py FOLDER``.

FOLDER holds ``precision.csv`` (four decimals), ``precision_by_category.csv`` (counts),
``threshold_curves.csv`` (counts) and ``run_time.csv``. What was printed rounded becomes the range
of counts that round to it; where the categories' counts add up to a cell, that is its count.
"""

import csv
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

GOLDEN = Path(__file__).parents[1] / "golden" / "published"


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)


def counts_that_print(precision: str, total: int) -> tuple[int, int]:
    decimals = len(precision.partition(".")[2])
    near = math.floor(float(precision) * total)
    slack = math.ceil(total * 10.0**-decimals)
    fits = [
        k
        for k in range(max(near - slack, 0), min(near + slack, total) + 1)
        if f"{k / total:.{decimals}f}" == precision
    ]
    if not fits:
        raise SystemExit(f"no count of {total} prints as {precision}")
    return fits[0], fits[-1]


def main(folder: Path) -> None:
    by_category = read(folder / "precision_by_category.csv")
    key = ("dataset", "method", "rotation_deg", "position_m", "fscore_1cm")
    exact: dict[tuple[str, ...], list[int]] = {}
    rows: list[tuple[object, ...]] = []
    for line in by_category:
        cell = exact.setdefault(tuple(line[k] for k in key), [0, 0])
        cell[0] += int(line["correct"])
        cell[1] += int(line["total"])
        where = (line["dataset"], line["method"], line["category"])
        limits = (line["rotation_deg"], line["position_m"], line["fscore_1cm"])
        rows.append((*where, *limits, line["correct"], line["correct"], line["total"]))
    totals = {(k[0], k[1]): total for k, (_, total) in exact.items()}
    for line in read(folder / "precision.csv"):
        limits = (line["rotation_deg"], line["position_m"], line["fscore_1cm"])
        total = totals[line["dataset"], line["method"]]
        low, high = counts_that_print(line["precision"], total)
        known = exact.get((line["dataset"], line["method"], *limits))
        if known is not None:
            if not low <= known[0] <= high:
                raise SystemExit(f"{line}: the categories add up to {known[0]}")
            low = high = known[0]
        rows.append((line["dataset"], line["method"], "all", *limits, low, high, total))
    columns = ("dataset", "method", "category", *key[2:], "correct_low", "correct_high", "total")
    write(GOLDEN / "precision.csv", columns, sorted(rows, key=lambda row: [str(x) for x in row]))
    columns = ("dataset", "method", "threshold_on", "threshold", "correct", "total")
    curves = read(folder / "threshold_curves.csv")
    write(GOLDEN / "curves.csv", columns, [[line[c] for c in columns] for line in curves])
    times = read(folder / "run_time.csv")
    write(GOLDEN / "run_time.csv", list(times[0]), [list(line.values()) for line in times])


if __name__ == "__main__":
    main(Path(sys.argv[1]))
