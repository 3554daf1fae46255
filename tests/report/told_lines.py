"""What the terminal shows of a report."""

from types import SimpleNamespace

from pytest_cpas.report.terminal import Terminal, print_run


def told(content: dict) -> list[str]:
    """The lines of its first run."""
    shown: list[str] = []
    reporter = SimpleNamespace(
        config=SimpleNamespace(get_verbosity=lambda: 0),
        section=lambda title, **_: None,
        write_line=lambda line, **_: shown.append(line),
    )
    print_run(Terminal(reporter), content["runs"][0], "computed")
    return shown
