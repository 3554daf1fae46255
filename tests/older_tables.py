"""Golden tables in the form of version 1, as its writer made them."""

import csv
import hashlib
import io
from pathlib import Path

from pytest_cpas._files import toml_string
from pytest_cpas.golden import RunTable
from pytest_cpas.types.samples import ALL

#: What facts were called, in the order of the columns of ``samples.csv``.
_ERRORS = {
    "position_m": "translation_error",
    "rotation_deg": "rotation_error",
    "iou": "iou",
    "fscore_1cm": "fscore_1cm",
}

_HEAD = (
    *("sample", "category", "outcome", "repeats", "translation_error_m", "rotation_error_deg"),
    *("iou", "fscore_1cm", "failure"),
)

#: The columns that it knew, which are the first of the default protocol.
_KNOWN = 4


def record_older(golden: Path, table: RunTable) -> Path:
    """Write the two files of a table below ``golden``, and return their folder."""
    folder = golden / "recorded" / table.method / table.dataset
    folder.mkdir(parents=True)
    for name, text in older_texts(table).items():
        (folder / name).write_text(text, encoding="utf-8", newline="")
    return folder


def older_texts(table: RunTable) -> dict[str, str]:
    """The texts of the two files."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(_HEAD)
    for name, sample in sorted(table.samples.items()):
        first, *others = (outcome[:_KNOWN] for outcome in sample.outcomes)
        repeats = " ".join(others) if set(others) - {first} else ""
        values = [sample.facts[fact] for fact in _ERRORS]
        told = ["" if value is None else f"{value:.6g}" for value in values]
        writer.writerow([name, sample.category, first, repeats, *told, sample.failure or ""])
    samples = lines.getvalue()
    identity = dict(table.identity)
    identity |= {then: table.definitions[now] for now, then in _ERRORS.items()}
    cells = {
        f"{category} | {column.label}": f"{count.correct}/{count.total}" if count else "n/a"
        for category, counts in table.table.items()
        for column in table.columns[:_KNOWN]
        for count in [counts[column.key]]
    }
    assert f"{ALL} | 10 deg, 2 cm" in cells
    head = [
        "# Recorded by pytest-cpas; --snapshot-update records it anew.",
        "format = 2",
        f"samples_sha256 = {toml_string(hashlib.sha256(samples.encode()).hexdigest())}",
        f"seeds = {table.seeds}",
    ]
    for title, values in (
        ("identity", identity),
        ("provenance", table.provenance),
        ("cells", cells),
    ):
        head += ["", f"[{title}]"]
        head += [f"{toml_string(k)} = {toml_string(v)}" for k, v in sorted(values.items())]
    return {"table.toml": "\n".join(head) + "\n", "samples.csv": samples}
