"""pytest's root directory, where the value of an option of ours stands as a word of its own.

pytest looks for its root directory and configuration file before it loads plugins: until then it
knows no option of theirs and takes the value in ``--cpas-data DIR`` for the path of a test.
"""

from __future__ import annotations

import copy
import inspect
import itertools
import os
import shlex
from pathlib import Path

import pytest

from pytest_cpas.reading.text import terminal_lines
from pytest_cpas.session.command_line import add_options


def check_rootdir(config: pytest.Config) -> None:
    """Raise :class:`pytest.UsageError`, which says what to type, if a value of one of our options
    was taken for a test path and has moved the root directory or the configuration file."""
    words = [os.fspath(word) for word in config.invocation_params.args]
    words[:0] = shlex.split(os.environ.get("PYTEST_ADDOPTS", ""))
    if not any(word.startswith(("--cpas-", "@")) and "=" not in word for word in words):
        return
    here = config.invocation_params.dir
    try:
        root, ini, paths = _setup(words, here)
    except (ImportError, AttributeError, TypeError):
        # another pytest than those that are tested: nothing is known of its root directory
        root, ini, paths = None, None, []
    if (root, ini) == (config.rootpath, config.inipath):
        return
    taken = [
        (option, value)
        for option, value in itertools.pairwise(words)
        if option.startswith("--cpas-") and "=" not in option
        if not value.startswith("-") and value not in paths
        if (here / value.partition("::")[0]).exists()
    ]
    if root is None and not taken:
        return
    forms = " ".join(shlex.quote(f"{option}={value}") for option, value in taken)
    told = (
        f"pytest took {' and '.join(value for _, value in taken) or 'the value of an option'} for"
        f" a test path, so its root directory is {config.rootpath} and its configuration file"
        f" {config.inipath or 'none'}"
        + (f"; it would be {root} with {ini or 'none'}" if root else "")
        + f". Write the option with the equals sign: {forms or '--cpas-data=DIR'}"
    )
    raise pytest.UsageError(terminal_lines(told))


def _setup(words: list[str], here: Path) -> tuple[Path | None, Path | None, list[str]]:
    """Root directory, configuration file and test paths, if pytest had known our options."""
    from _pytest.config import get_config
    from _pytest.config.findpaths import determine_setup

    fresh = get_config(words)
    add_options(fresh._parser)
    options, unknown = fresh._parser.parse_known_and_unknown_args(
        words, namespace=copy.copy(fresh.option)
    )
    given = {
        "inifile": options.inifilename,
        "override_ini": options.override_ini,
        "args": options.file_or_dir + unknown,
        "rootdir_cmd_arg": options.rootdir or None,
        "invocation_dir": here,
    }
    known = inspect.signature(determine_setup).parameters
    root, ini, *_ = determine_setup(**{name: given[name] for name in known})
    return root, ini, options.file_or_dir
