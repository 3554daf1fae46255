"""pytest options and the hooks that must exist before anything is known about a run.

Everything else is in :mod:`pytest_cpas.session`, which is imported only when an option of ours is
given, but for the list of options: people install this plugin beside unrelated projects.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import pytest

from pytest_cpas.session.command_line import add_options

if TYPE_CHECKING:
    from collections.abc import Mapping

    from syrupy.assertion import SnapshotAssertion

    from pytest_cpas.golden.snapshot import GoldenAssertion

#: What runs methods, judges samples, or takes only some of them.
_METHOD = ("--cpas-method",)
_RUN = (*_METHOD, "--cpas-predictions", "--cpas-merge")
_SELECTING = (*_METHOD, "--cpas-predictions", "--cpas-check-dataset")

#: What does nothing unless one of others is given too. Settings that a project may keep for its own
#: tests as well (data, weights, golden tables, device, seed) are not among them.
NEEDS: Mapping[str, tuple[str, ...]] = {
    "--cpas-dataset": _RUN,
    "--cpas-benchmark": _METHOD,
    "--cpas-detections": _METHOD,
    "--cpas-report": _RUN,
    "--cpas-results": _RUN,
    "--cpas-save-predictions": (*_METHOD, "--cpas-predictions"),
    "--cpas-results-reuse": ("--cpas-results", "--cpas-merge"),
    "--cpas-require-golden": _RUN,
    "--cpas-granularity": (*_RUN, "--cpas-check-dataset"),
    "--cpas-category": _SELECTING,
    "--cpas-limit": _SELECTING,
    "--cpas-shard": _SELECTING,
    "--cpas-profile": _METHOD,
    "--cpas-timeout": _METHOD,
    "--cpas-jitter": _METHOD,
    "--cpas-batch": _METHOD,
    "--cpas-trace": _METHOD,
    "--cpas-trace-max": ("--cpas-trace",),
    "--cpas-trace-spread": ("--cpas-trace",),
    "--cpas-parity": _METHOD,
    "--cpas-parity-map": ("--cpas-parity",),
    "--cpas-parity-propose": ("--cpas-parity",),
    "--cpas-benchmark-against": ("--cpas-benchmark",),
    "--cpas-benchmark-fail": ("--cpas-benchmark",),
    "--cpas-against": ("--cpas-report",),
    "--cpas-allow-gaps": ("--cpas-merge",),
    "--cpas-examples": ("--cpas-metrics",),
    "--cpas-no-shrink": ("--cpas-metrics",),
    "--cpas-metrics-report": ("--cpas-metrics",),
    "--cpas-known-faults": ("--cpas-check-dataset", "--cpas-dataset"),
    "--cpas-categories": ("--cpas-check-dataset", "--cpas-dataset"),
    "--cpas-pictures": ("--cpas-check-dataset",),
}

#: What to type for the first of them.
EXAMPLES: Mapping[str, str] = {
    "--cpas-method": "--cpas-method icp --cpas-dataset synthetic-tabletop",
    "--cpas-benchmark": "--cpas-benchmark",
    "--cpas-trace": "--cpas-trace DIR",
    "--cpas-parity": "--cpas-parity git:HEAD~1",
    "--cpas-report": "--cpas-report DIR",
    "--cpas-results": "--cpas-results DIR",
    "--cpas-merge": "--cpas-merge FILE",
    "--cpas-metrics": "--cpas-metrics cpas",
    "--cpas-check-dataset": "--cpas-check-dataset synthetic-tabletop",
}


#: The values of options that need none. They follow an equals sign: a word of its own is a path.
OPTIONAL_VALUES: Mapping[str, tuple[str, ...]] = {"--cpas-require-golden": ("strict",)}


def pytest_addoption(parser: pytest.Parser, pluginmanager: pytest.PytestPluginManager) -> None:
    """Add the ``--cpas-*`` options; a run that asks for verdicts is guarded from here on."""
    add_options(parser)
    config = pluginmanager.get_plugin("pytestconfig")
    if config is not None:
        from pytest_cpas.session.guard import guard

        guard(config, parser)


@pytest.hookimpl(tryfirst=True)
def pytest_load_initial_conftests(early_config: pytest.Config) -> None:
    """Refuse a run whose root directory an option of ours has moved; no conftest.py has been
    loaded yet."""
    from pytest_cpas.session.own_settings import note_others
    from pytest_cpas.session.rootdir import check_rootdir

    check_rootdir(early_config)
    note_others(early_config)


def pytest_cmdline_main(config: pytest.Config) -> int | None:
    """``--cpas-list`` prints and ends."""
    if not config.option.cpas_list:
        return None
    from pytest_cpas.listing import listing
    from pytest_cpas.reading.text import say, terminal_lines
    from pytest_cpas.remote import named_methods, project_folder
    from pytest_cpas.session.protocol_names import known_protocols
    from pytest_cpas.types import ContractError

    weights = config.option.cpas_weights
    try:
        protocols = known_protocols(config.rootpath)
        elsewhere = named_methods(project_folder(config.rootpath, config.invocation_params.dir))
    except ContractError as error:
        raise pytest.UsageError(terminal_lines(str(error))) from error
    folder = config.invocation_params.dir / weights if weights else None
    for line in listing(folder, protocols, elsewhere):
        say(line)
    return 0


@pytest.fixture
def cpas_golden(snapshot: SnapshotAssertion, pytestconfig: pytest.Config) -> GoldenAssertion:
    """The golden table that a :class:`pytest_cpas.golden.RunTable` is compared with by ``==``.

    Which one follows from the table's method and data set; ``--snapshot-update`` records it.
    """
    from pytest_cpas.golden.snapshot import GoldenAssertion, GoldenExtension

    return GoldenAssertion(
        session=snapshot.session,
        extension_class=GoldenExtension.of(pytestconfig),
        test_location=snapshot.test_location,
        update_snapshots=snapshot.update_snapshots,
        update_new_snapshots_only=snapshot.update_new_snapshots_only,
    )


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Resolve what is asked for before collection, so that a mistake is a usage error."""
    options = config.option
    if options.help or options.version:
        return
    _check_needs(config)
    _check_optional_values(config)
    if options.cpas_method or options.cpas_predictions or options.cpas_merge:
        from pytest_cpas.session.method_session import CpasSession

        config.pluginmanager.register(CpasSession(config), "cpas-session")
    if options.cpas_metrics:
        from pytest_cpas.session.metrics_session import MetricsSession

        config.pluginmanager.register(MetricsSession(config), "cpas-metrics-session")
    if options.cpas_check_dataset:
        from pytest_cpas.session.dataset_session import DatasetSession

        config.pluginmanager.register(DatasetSession(config), "cpas-dataset-session")
    if options.cpas_benchmark and options.cpas_method:
        from pytest_cpas.session.speed_session import SpeedSession

        config.pluginmanager.register(SpeedSession(config), "cpas-speed-session")
    if options.cpas_method and (options.cpas_trace or options.cpas_parity):
        from pytest_cpas.session.parity_session import ParitySession

        config.pluginmanager.register(ParitySession(config), "cpas-parity-session")
    from pytest_cpas.session.guard import asked, watch

    if asked(options):
        watch(config)


def _check_needs(config: pytest.Config) -> None:
    """Refuse what was typed in vain; a configuration file may hold it for other runs."""
    typed = {str(argument).partition("=")[0] for argument in config.invocation_params.args}
    vain = [
        f"{option} does nothing without {' or '.join(needed)}; add for example"
        f" {EXAMPLES[needed[0]]}"
        for option, needed in NEEDS.items()
        if option in typed and not any(config.getoption(_destination(other)) for other in needed)
    ]
    if vain:
        raise pytest.UsageError("\n".join(vain))


def _check_optional_values(config: pytest.Config) -> None:
    """Refuse a value that stands as a word of its own, unless there is such a path."""
    words = [str(argument) for argument in config.invocation_params.args]
    for option, value in itertools.pairwise(words):
        is_path = (config.invocation_params.dir / value).exists()
        if value in OPTIONAL_VALUES.get(option, ()) and not is_path:
            raise pytest.UsageError(
                f"{option} {value}: pytest takes {value} for the path of a test; write"
                f" {option}={value}"
            )


def _destination(option: str) -> str:
    return option.removeprefix("--").replace("-", "_")
