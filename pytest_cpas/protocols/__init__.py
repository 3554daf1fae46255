"""What is made of facts: protocols, each a name, a version and columns, and a pure judge."""

from pytest_cpas.protocols.columns import (
    Column,
    CountColumn,
    Protocol,
    ProtocolError,
    RankingColumn,
    ScoreColumn,
)
from pytest_cpas.protocols.files import (
    PAPER,
    asked_for,
    read_protocol,
    shipped_protocol,
    shipped_protocols,
)
from pytest_cpas.protocols.intervals import (
    Intervals,
    IntervalTable,
    count_intervals,
    score_intervals,
)
from pytest_cpas.protocols.judging import (
    Score,
    ScoreTable,
    Table,
    count_columns,
    count_table,
    facts_of,
    judge_outcomes,
    ranking_columns,
    score_columns,
    score_table,
)
from pytest_cpas.protocols.ranking import RankedDetection, Ranking, rank, ranking_table

__all__ = [
    "PAPER",
    "Column",
    "CountColumn",
    "IntervalTable",
    "Intervals",
    "Protocol",
    "ProtocolError",
    "RankedDetection",
    "Ranking",
    "RankingColumn",
    "Score",
    "ScoreColumn",
    "ScoreTable",
    "Table",
    "asked_for",
    "count_columns",
    "count_intervals",
    "count_table",
    "facts_of",
    "judge_outcomes",
    "rank",
    "ranking_columns",
    "ranking_table",
    "read_protocol",
    "score_columns",
    "score_intervals",
    "score_table",
    "shipped_protocol",
    "shipped_protocols",
]
