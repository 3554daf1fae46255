"""Golden tables: what a run was when somebody looked at it and found it right.

``recorded/METHOD/DATASET/`` has what the run is of (``run.toml``), what was measured of every
sample (``facts.csv``), and a file for each protocol that it was judged under, with a cell per line.
The facts decide; the cells follow from them, and are checked on reading. All points of a robustness
profile are in the files of one folder, ``DATASET+robustness``. Tables of earlier versions
(``table.toml``, ``samples.csv``) are read as far as they go. What a table says about a run is in
:mod:`pytest_cpas.golden.comparison`.
"""

from pytest_cpas.golden.comparison import compare
from pytest_cpas.golden.exact import ELSEWHERE, detectable_flips
from pytest_cpas.golden.files import (
    find_golden,
    keep_noise,
    left_over,
    orphans,
    read_golden,
    read_tables,
    record,
    shipped_golden,
)
from pytest_cpas.golden.jitter import recorded_words
from pytest_cpas.golden.noise import Noise
from pytest_cpas.golden.pairing import SharedColumn, shared_columns
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
from pytest_cpas.golden.revisions import golden_diff
from pytest_cpas.golden.spread import ALARM
from pytest_cpas.golden.tables import (
    GoldenError,
    RunTable,
    TableSample,
    describe,
    differences,
    other_conditions,
)
from pytest_cpas.golden.texts import FORMAT
from pytest_cpas.golden.words import Word
from pytest_cpas.types import Verdict

__all__ = [
    "ALARM",
    "ELSEWHERE",
    "FORMAT",
    "GoldenError",
    "Noise",
    "PublishedCell",
    "PublishedTime",
    "RunTable",
    "SharedColumn",
    "TableSample",
    "Verdict",
    "Word",
    "compare",
    "compare_published",
    "count_problems",
    "describe",
    "detectable_flips",
    "differences",
    "find_golden",
    "golden_diff",
    "keep_noise",
    "left_over",
    "orphans",
    "other_conditions",
    "published_cells",
    "published_curves",
    "published_datasets",
    "published_methods",
    "published_name",
    "published_sample_counts",
    "published_time",
    "read_golden",
    "read_tables",
    "record",
    "recorded_words",
    "shared_columns",
    "shipped_golden",
]
