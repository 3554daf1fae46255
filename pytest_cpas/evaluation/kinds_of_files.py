"""What a file of a program is, by its name."""

from __future__ import annotations

import re
from pathlib import Path

__all__ = ["CODE", "READ", "SETTINGS", "TELLS", "TOOLS", "may_grow"]

#: What is code, whoever runs it, by the end of its name.
CODE = re.compile(
    r".*\.(py[cdwxz]?|pxd|so(\.\d+)*|dll|dylib|[ao]|(ba)?sh|bat|ps1|zip|egg|whl|c|cc|cpp|cxx|cuh?|h|hh"
    r"|hpp|cl|glsl|ptx|lua|jl|m|r|pl|js|wasm)",
    re.IGNORECASE | re.DOTALL,
)

#: The same, and settings.
SETTINGS = re.compile(
    rf".*\.(json5?|ya?ml|toml|ini|cfg|conf|gin|env|xml|prototxt|pbtxt)|{CODE.pattern}",
    re.IGNORECASE | re.DOTALL,
)

#: The same, and tables of numbers: what is read while code runs.
READ = re.compile(
    r".*\.(np[yz]|pkl|pickle|pth?|ckpt|onnx|h5|hdf5|safetensors|mat|joblib|bin)"
    rf"|{SETTINGS.pattern}",
    re.IGNORECASE | re.DOTALL,
)

#: What tells of a program, or grows while it runs, and is read by none, unless its text names it.
TELLS = re.compile(
    r"\..*|.*~|.*\.(md|rst|log|out|err|jsonl|lock|old|orig|bak|tmp|sw[op]|part|unfinished(-\w+)?)"
    r"|(.*[^a-z])?logs?(\.txt)?|(readme|licen[cs]e|copying|changelog|changes|notice)(\.txt)?",
    re.IGNORECASE | re.DOTALL,
)

#: Files that are about a method and no part of it, unless its text names them.
TOOLS = re.compile(
    r"test_.*\.py|.*_test\.py|conftest\.py|setup\.(py|cfg)|pyproject\.toml|noxfile\.py"
    r"|(pytest|tox)\.ini|mkdocs\.yml|(.*\.)?known\.toml"
    r"|(.*[^a-z])?(junit|coverage|tests?|test-?results?)([^a-z].*)?\.(xml|html)"
)


def may_grow(path: Path) -> bool:
    """Whether a file may be something's output by its name: it is neither code nor settings."""
    return not READ.fullmatch(path.name)
