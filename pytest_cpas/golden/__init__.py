"""Golden tables: what a run was when somebody looked at it and found it right.

``recorded/METHOD/DATASET/table.toml`` holds one cell per line, exact counts, and where they come
from; ``samples.csv`` beside it one line per sample: which thresholds it met (see
:func:`pytest_cpas.evaluation.outcomes`) and its errors, rounded, for people. The outcomes decide;
the counts are checked against them on reading. What a table says about a run is in
:mod:`pytest_cpas.golden.comparison`.
"""

from pytest_cpas.golden.comparison import Word, compare, detectable_flips
from pytest_cpas.golden.files import find_golden, orphans, read_golden, record, shipped_golden
from pytest_cpas.golden.jitter import recorded_words
from pytest_cpas.golden.published import (
    PublishedCell,
    PublishedTime,
    compare_published,
    count_problems,
    published_cells,
    published_curves,
    published_datasets,
    published_methods,
    published_name,
    published_sample_counts,
    published_time,
)
from pytest_cpas.golden.spread import ALARM
from pytest_cpas.golden.tables import (
    FORMAT,
    GoldenError,
    RunTable,
    TableSample,
    differences,
    parse_golden,
)
from pytest_cpas.types import Verdict

__all__ = [
    "ALARM",
    "FORMAT",
    "GoldenError",
    "PublishedCell",
    "PublishedTime",
    "RunTable",
    "TableSample",
    "Verdict",
    "Word",
    "compare",
    "compare_published",
    "count_problems",
    "detectable_flips",
    "differences",
    "find_golden",
    "orphans",
    "parse_golden",
    "published_cells",
    "published_curves",
    "published_datasets",
    "published_methods",
    "published_name",
    "published_sample_counts",
    "published_time",
    "read_golden",
    "record",
    "recorded_words",
    "shipped_golden",
]
