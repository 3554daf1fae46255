"""The files of a report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from pytest_cpas._files import write_file
from pytest_cpas.documents import Document
from pytest_cpas.report.export import precision_csv, precision_tex, scores_csv
from pytest_cpas.report.markdown import markdown
from pytest_cpas.report.page import page
from pytest_cpas.report.panels import ValuePictures


def write_report(
    document: Document,
    folder: Path,
    pictures: Mapping[tuple[str, str], Mapping[str, bytes]],
    values: Mapping[tuple[str, str], ValuePictures] = MappingProxyType({}),
) -> None:
    """Write ``report.json``, ``.md`` and ``.html``, ``precision.csv``, ``scores.csv`` and
    ``precision.tex``.

    Each is written as a whole or not at all.

    ``pictures``: WebP pictures by method and data set, and by sample, for the page; ``values``:
    those of the value at which a method parts from another one.

    Raises :class:`OSError` if a disk does not take them, or if one of them is a link.
    """
    contents: dict[str, str] = {
        "report.json": json.dumps(document, indent=1, allow_nan=False) + "\n",
        "report.md": markdown(document),
        "precision.csv": precision_csv(document),
        "scores.csv": scores_csv(document),
        "precision.tex": precision_tex(document),
        "report.html": page(document, pictures, values),
    }
    for name, content in contents.items():
        write_file(folder / name, content, below=folder)
