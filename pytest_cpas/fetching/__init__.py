"""``pytest-cpas fetch``: data sets and weights from where they are published."""

from pytest_cpas.fetching.command import fetch, find_source
from pytest_cpas.fetching.download import FetchError

__all__ = ["FetchError", "fetch", "find_source"]
