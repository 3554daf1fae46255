"""Where what can be made again is kept."""

from __future__ import annotations

import os
from pathlib import Path

import platformdirs


def cache_folder() -> Path:
    """``CPAS_CACHE``, or the user's cache; it need not exist."""
    named = os.environ.get("CPAS_CACHE")
    return Path(named) if named else platformdirs.user_cache_path("pytest-cpas")
