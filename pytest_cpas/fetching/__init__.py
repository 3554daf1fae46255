"""``pytest-cpas fetch``: data sets and weights from where they are published."""

from pytest_cpas.fetching.download import FetchError
from pytest_cpas.fetching.fetch import fetch, find_source

__all__ = ["FetchError", "fetch", "find_source"]
