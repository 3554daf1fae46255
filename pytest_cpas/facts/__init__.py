"""What is measured of one answer: named facts, each with the id of its definition.

A fact is a number about one answer beside the truth, never a judgement: what is made of facts is
:mod:`pytest_cpas.protocols`'s.
"""

from pytest_cpas.facts.answers import AnswerBatch, declared_part
from pytest_cpas.facts.catalogue import all_facts, fact, in_order
from pytest_cpas.facts.fact import SAME, Fact, FactError, Facts
from pytest_cpas.facts.measuring import failed_facts, measure_facts
from pytest_cpas.facts.pairs import Detected, PairTable, pair_table

__all__ = [
    "SAME",
    "AnswerBatch",
    "Detected",
    "Fact",
    "FactError",
    "Facts",
    "PairTable",
    "all_facts",
    "declared_part",
    "fact",
    "failed_facts",
    "in_order",
    "measure_facts",
    "pair_table",
]
