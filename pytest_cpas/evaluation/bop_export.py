"""Stored results of a run on a data set in BOP format as the file that BOP's evaluation reads."""

from __future__ import annotations

import re
from pathlib import Path

from pytest_cpas._files import write_file
from pytest_cpas.datasets._bop_models import find_models, read_models
from pytest_cpas.datasets.bop import find_split, object_number
from pytest_cpas.evaluation.estimates import decode_estimates
from pytest_cpas.evaluation.results import ResultsError, read_results
from pytest_cpas.evaluation.rows import Row
from pytest_cpas.submissions import BOP_HEADER, bop_line
from pytest_cpas.types import ContractError, DataError, Hypothesis

_SAMPLE = re.compile(r"([0-9]{1,9})/([0-9]{1,9})/[0-9]{1,9}")


def export_bop(results: Path, data: Path, target: Path) -> int:
    """Write the estimates of a results file to ``target``; returns how many there are.

    ``data``: the folder of the data set, whose models say where BOP's origin is. One line for each
    estimate: rotation row by row, translation in millimetres, score 1, time -1 (not measured).
    Failed predictions have no line. Raises :class:`ResultsError` if the results are of another
    data set or without estimates, or if an estimate is no pose.
    """
    read = read_results(results)
    root, _ = find_split(data)
    models, _ = read_models(root / find_models(root))
    rows = [row for row in read.rows.values() if row.failure is None]
    lines = [BOP_HEADER]
    estimates = decode_estimates([row.estimate for row in rows if row.estimate is not None])
    if not read.header.dataset.startswith("bop-") or len(estimates.rotation) != len(rows):
        raise ResultsError(
            f"{results}: of {read.header.dataset}, {len(estimates.rotation)} estimates in"
            f" {len(rows)} rows; expected the results of --cpas-dataset bop:DIR with an estimate"
            " in every row (results of older versions have none: run again)"
        )
    for row, rotation, translation in zip(
        rows, estimates.rotation, estimates.translation, strict=True
    ):
        try:
            scene, image, number = _place(row)
            estimate = Hypothesis(rotation=rotation, translation=translation)
        except ContractError as error:
            raise ResultsError(f"{results}: sample {row.sample[:80]!r}: {error}") from None
        if number not in models:
            raise ResultsError(f"{results}: {row.category} is not in the models of {root}")
        lines.append(bop_line((scene, image, number), estimate, models[number].centre))
    write_file(target, "\n".join(lines) + "\n", below=target.parent)
    return len(rows)


def _place(row: Row) -> tuple[int, int, int]:
    """Scene, image and object of a row; :class:`DataError` if its sample is not of BOP."""
    match = _SAMPLE.fullmatch(row.sample)
    if match is None:
        raise DataError("expected scene, image and place in it, such as 000001/000003/0")
    return int(match[1]), int(match[2]), object_number(row.category)
