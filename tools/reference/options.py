"""Options of the plugin, its ini options, and the subcommands of ``pytest-cpas``."""

import argparse
import os
import re
from unittest import mock

from pytest_cpas.cli import command_line
from pytest_cpas.session.command_line import add_options
from reference.markdown import code, codes, heading, table


class _Recorder:
    """Takes what ``pytest_addoption`` adds."""

    def __init__(self) -> None:
        self.group = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        self.inis: dict[str, str] = {}

    def getgroup(self, name: str, description: str) -> "_Recorder":
        return self

    def addoption(self, *names: str, **attributes: object) -> None:
        self.group.add_argument(*names, **attributes)

    def addini(self, name: str, help: str, **_: object) -> None:  # noqa: A002 - pytest's name
        self.inis[name] = help


def recorded() -> _Recorder:
    """The options, as they are where no environment variable gives a default."""
    recorder = _Recorder()
    others = {name: value for name, value in os.environ.items() if not name.startswith("CPAS_")}
    with mock.patch.dict(os.environ, others, clear=True):
        add_options(recorder)
    return recorder


def parser_options() -> list[argparse.Action]:
    """Every option of the plugin."""
    return [a for a in _actions(recorded().group) if a.help != argparse.SUPPRESS]


def subcommands() -> dict[str, argparse.ArgumentParser]:
    """Every subcommand of ``pytest-cpas``."""
    actions = _actions(command_line())
    (choices,) = [a.choices for a in actions if isinstance(a, argparse._SubParsersAction)]
    return dict(choices)


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    return [a for a in parser._actions if not isinstance(a, argparse._HelpAction)]


def options() -> str:
    """One section per option: so that each can be linked to."""
    return "\n\n".join(_option(action) for action in parser_options())


#: What a help text says that has a place of its own here.
_ASIDE = re.compile(r" \((?:default: ([^)]*)|repeatable)\)")


def default(action: argparse.Action) -> str:
    """The default of an option in words; one that the parser does not hold as its help says."""
    if isinstance(action, argparse._StoreTrueAction):
        return "off"
    if action.default not in (None, []):
        return code(action.default)
    return next(filter(None, _ASIDE.findall(action.help)), "none")


def _option(action: argparse.Action) -> str:
    (name,) = action.option_strings
    values = "\\|".join(map(str, action.choices)) if action.choices else action.metavar
    title = f"{name} {values}" if values else name
    facts = [f"Default: {default(action)}"]
    if action.choices:
        facts.append(f"one of {codes(action.choices)}")
    if isinstance(action, argparse._AppendAction):
        facts.append("can be given several times")
    text = _plain(action.help)
    return f"{heading(3, title, name.strip('-'))}\n\n{text}.\n\n{'; '.join(facts)}."


def _plain(text: str) -> str:
    # argparse writes a percent sign as two
    return _ASIDE.sub("", text[0].upper() + text[1:]).replace("%%", "%")


def ini() -> str:
    """The options of pytest's configuration file."""
    return table(["ini option", "meaning"], ((code(k), v) for k, v in recorded().inis.items()))


def commands() -> str:
    """One section per subcommand."""
    return "\n\n".join(_command(name, parser) for name, parser in subcommands().items())


def _command(name: str, parser: argparse.ArgumentParser) -> str:
    usage = " ".join(parser.format_usage().removeprefix("usage: ").split())
    lines = [heading(3, f"pytest-cpas {name}", name), f"    {usage}", parser.description]
    rows = [
        (code(" ".join([*action.option_strings, action.metavar or ""]).strip()), action.help or "")
        for action in _actions(parser)
    ]
    return "\n\n".join([*lines, table(["argument", "meaning"], rows)])
