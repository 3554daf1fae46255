"""A program that changes while it runs: its rows are nobody's, and so would be its golden table."""

import importlib
import sys
import time

import pytest
import tiny

from pytest_cpas.checks.contract import CONTRACT, ContractResult
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.evaluation import (
    MethodRun,
    ResultsError,
    ResultsFile,
    Shard,
    merge,
    read_results,
    surroundings,
)
from pytest_cpas.evaluation.meanwhile import Meanwhile
from pytest_cpas.evaluation.program import program_of
from pytest_cpas.session.collected import CollectedRun, ItemResult
from pytest_cpas.session.judging import record_run

WHOLE = Shard(1, 1)

FILES = {
    "setup.py": "",
    "conftest.py": "",
    "adapters/mine.py": """
from dataclasses import replace
import tiny
from pytest_cpas.types import Asset

class Mine(tiny.Perfect):
    info = replace(tiny.Perfect.info, assets=(Asset(path="w.pt", url="http://x", licence="MIT"),))
    settings = "settings.yaml"

    def load(self, assets, device):
        super().load(assets, device)
        from adapters import helper
        try:
            from adapters import faster
        except ImportError:
            pass

class Undeclared(Mine):
    info = tiny.Perfect.info
""",
    "adapters/helper.py": "angle = 0",
    "adapters/settings.yaml": "angle: 0",
    "tables/mean.csv": "0",
    "weights/w.pt": "0",
}


@pytest.fixture
def project(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(surroundings, "_left_out", set())
    monkeypatch.setattr("pytest_cpas.evaluation.meanwhile._SHARE", 1e9)  # however slow the disk is
    for name, text in FILES.items():
        write(tmp_path / name, text)
    surroundings.leave_out(tmp_path / name for name in ("weights", "out", "golden"))
    yield tmp_path
    _forget()


def _forget():
    for name in [name for name in sys.modules if name.partition(".")[0] == "adapters"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    program_of.cache_clear()


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def a_run(project, name="Mine", began=None):
    _forget()
    method = getattr(importlib.import_module("adapters.mine"), name)
    run = MethodRun(method(), tiny.Tiny(None), weights=project / "weights")
    run.began(time.time_ns() if began is None else began, [project / "conftest.py"])
    return run


def a_row(run, index):
    return run.judge(run.samples[index])


def _away_and_back(path):
    path.rename(path.with_suffix(".old"))
    path.with_suffix(".old").rename(path)


def _other_and_back(path):
    text = path.read_text()
    path.write_text("angle = 7")
    path.write_text(text)


HELPER, FASTER, SETTINGS = "adapters/helper.py", "adapters/faster.py", "adapters/settings.yaml"

#: What is done to a file while a run goes on, and what is said to have changed.
CHANGES = {
    "module": (HELPER, lambda path: path.write_text("angle = 7"), HELPER),
    "module, changed back": (HELPER, _other_and_back, HELPER),
    "module, moved back": (HELPER, _away_and_back, HELPER),
    "module removed": (HELPER, lambda path: path.unlink(), f"{HELPER} (gone)"),
    "settings": (SETTINGS, lambda path: path.write_text("angle: 7"), SETTINGS),
    "plugin": ("conftest.py", lambda path: path.write_text("angle = 7"), "conftest.py"),
    "weights": ("weights/w.pt", lambda path: path.write_text("7"), "the weights w.pt"),
    "weights, changed back": ("weights/w.pt", _other_and_back, "the weights w.pt"),
    "around": ("tables/mean.csv", lambda path: path.write_text("7"), "tables/mean.csv"),
}

#: The same, of what is seen at the end alone.
AT_THE_END = {
    "new module": (
        "adapters/faster.py",
        lambda path: path.write_text(""),
        "adapters/faster.py (new)",
    ),
    "new around": ("tables/new.csv", lambda path: path.write_text("7"), "tables/new.csv (new)"),
}

#: Of what golden tables do not tell.
AROUND = ("around", "new around")


@pytest.mark.parametrize("what", CHANGES | AT_THE_END)
def test_rows_are_not_reused_though_all_files_are_as_they_were(project, what):
    at, change, name = (CHANGES | AT_THE_END)[what]
    run = a_run(project)
    collected = CollectedRun(run, ResultsFile(project / "out", run, WHOLE))
    with collected:
        collected.add(ItemResult([a_row(run, 0)]))
        change(project / at)
        collected.add(ItemResult([a_row(run, 1)]))
        killed = (project / "out" / "perfect-tiny.jsonl").read_bytes()
    assert collected.origin == f"computed 2 while {name} changed"
    (project / at).unlink(missing_ok=True)
    if at in FILES:
        write(project / at, FILES[at])
    path = project / "out" / "perfect-tiny.jsonl"
    endings = [path.read_bytes()] + ([killed] if what in CHANGES else [])
    again = a_run(project)
    for content in endings:
        path.write_bytes(content)
        file = ResultsFile(project / "out", again, WHOLE)
        assert not file.rows
        told = f"not reused 2 of another program (changed while it ran: {name})"
        assert str(file.set_aside) == told
        assert len(ResultsFile(project / "out", again, WHOLE, reuse_any=True).rows) == 2


@pytest.mark.parametrize(
    "what", [None, "module", "module, moved back", "weights", "plugin", *AROUND, "new module"]
)
def test_no_golden_table_is_recorded_of_two_programs(project, what):
    run = a_run(project)
    collected = CollectedRun(run)
    for name in CONTRACT:
        collected.add(ItemResult(contract=ContractResult(name, Outcome.PASSED, demanded=True)))
    for index in range(len(run.samples)):
        collected.add(ItemResult([a_row(run, index)]))
    told = "RECORDED"
    if what:
        at, change, name = (CHANGES | AT_THE_END)[what]
        change(project / at)
        told = told if what in AROUND else f"NOT RECORDED: {name}: changed since the run began"
    (verdict,) = record_run(collected, project / "golden", failed_items=0).verdicts
    assert told in str(verdict)
    assert (project / "golden").exists() == (told == "RECORDED")


def test_what_a_method_writes_as_it_was_has_not_changed(project):
    run = a_run(project)
    for name in (SETTINGS, "tables/mean.csv"):
        _other_and_back(project / name)
        write(project / "adapters/log.txt", "growing")
    assert not run.changed_meanwhile(thoroughly=True)


def test_what_grows_is_an_output(project):
    """Such as that of ``pytest ... | tee out.txt``, unless the method's text names it."""
    write(project / "out.txt", "first\n")
    run = a_run(project)
    for name in ("out.txt", "tables/mean.csv", SETTINGS):
        with (project / name).open("a") as file:
            file.write("more\n")
        run.changed_meanwhile()
    assert run.changed_meanwhile(thoroughly=True) == {SETTINGS: True}
    write(project / "out.txt", "other and longer\n")
    assert run.changed_meanwhile() == {SETTINGS: True, "out.txt": False}


def test_what_was_imported_before_it_was_seen(project):
    """An edit after pytest began and before the program was looked for: which one was imported?"""
    before = time.time_ns() - 10**10
    assert HELPER in a_run(project, began=before).changed_meanwhile()
    assert SETTINGS not in a_run(project, began=before).changed_meanwhile()
    assert not a_run(project).changed_meanwhile()


def test_weights_that_are_not_declared(project):
    run = a_run(project, "Undeclared")
    write(project / "weights/w.pt", "7")
    assert run.changed_meanwhile() == {"the weights w.pt": True}


def test_a_program_that_changed_is_not_merged_unless_asked_for(project):
    run = a_run(project)
    with ResultsFile(project / "out", run, WHOLE) as file:
        for index in range(len(run.samples)):
            file.add(a_row(run, index))
        write(project / HELPER, "angle = 7")
    with pytest.raises(ResultsError, match=rf"the program has changed while .* \({HELPER}\)"):
        merge([file.path])
    (merged,) = merge([file.path], any_program=True)
    assert merged.several_programs
    assert merged.provenance["code"] == f"{run.provenance['code']} and changed while it ran"


def test_a_change_is_told_once_in_a_file(project):
    run = a_run(project)
    with ResultsFile(project / "out", run, WHOLE) as file:
        for index in range(4):
            file.add(a_row(run, index))
            write(project / HELPER, f"angle = {index}")
    assert file.path.read_bytes().count(b'{"changed":') == 1
    assert read_results(file.path).changed == [HELPER]


def test_looking_takes_a_share_of_the_time(monkeypatch):
    """However many files there are, and however fast rows come."""
    looks = []
    meanwhile = Meanwhile({})
    monkeypatch.setattr("pytest_cpas.evaluation.meanwhile.time.monotonic", lambda: clock[0])
    clock = [0.0]

    class Slow(dict):
        def items(self):
            looks.append(clock[0])
            clock[0] += 1
            return []

    meanwhile._files = Slow()
    while clock[0] < 100:
        meanwhile.look()
        clock[0] += 0.5
    assert len(looks) <= 6
