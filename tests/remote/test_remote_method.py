"""A method behind a worker is as one that is here: contract, facts, identity, random states."""

import ast
import platform
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tiny
import workers

from pytest_cpas.checks.contract import CONTRACT, MethodSubject, check_contract
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.remote import remote_method
from pytest_cpas.remote import worker as worker_file
from pytest_cpas.timing.contestant import Contestant

#: Where tests/tiny.py is.
TESTS = str(Path(tiny.__file__).parent)


@pytest.fixture
def remote():
    """Makes methods of workers, and sees that none is left."""
    made = []

    def make(cls: str, **changes: object):
        asked = workers.spec(cls, **changes)
        made.append((asked, remote_method(asked)))
        return made[-1][1]

    yield make
    for _, method in made:
        method.remote.close()
    for asked, _ in made:
        assert workers.left_of(asked) == []


@pytest.mark.parametrize("name", ["Perfect", "Several", "Refuses"])
def test_rows_are_those_of_the_method_here(remote, name):
    here = MethodRun(getattr(tiny, name)(), tiny.Tiny(None), keeps_shapes=True)
    there = MethodRun(remote(f"tiny:{name}", path=(TESTS,))(), tiny.Tiny(None), keeps_shapes=True)
    assert there.info == here.info
    for ref in here.samples:
        assert there.judge(ref) == here.judge(ref)


@pytest.mark.parametrize(
    ("name", "check"),
    [
        ("ChangesInput", "inputs_unmodified"),
        ("DrawsGlobally", "global_random_state_untouched"),
        ("DependsOnGlobal", "global_random_state"),
    ],
)
def test_contract_sees_what_happens_there(remote, name, check):
    method = remote(f"planted_methods:{name}")()
    run = MethodRun(method, tiny.Tiny(None))
    samples = [run.read(ref) for ref in run.samples[:2]]
    for subject, outcome in (
        (MethodSubject(run.limited(run.loaded()), samples), True),
        (MethodSubject(_loaded(remote("planted_methods:Good")()), samples), False),
    ):
        assert check_contract(subject, CONTRACT[check]).violated == outcome


def _loaded(method):
    method.load(None, "cpu")
    return method


def test_what_numpy_makes_of_a_declaration_is_read(remote):
    info = remote("planted_declarations:DeclaredInNumpy").info
    assert (info.categories, info.deterministic, info.tolerance) == (("mug",), True, 0.25 / 1024)


def test_advice_is_for_plain_values_where_the_method_is_of_those(remote):
    told = {}
    for cls, path in (("planted_methods:Good", workers.HERE), ("tiny:Perfect", TESTS)):
        told[cls] = MethodSubject(remote(cls, path=(str(path),))(), []).say_why
    assert told == {
        "planted_methods:Good": 'return {"failed": "why"}',
        "tiny:Perfect": "return Prediction.failed with the reason",
    }


def test_instances_of_one_worker_are_apart(remote):
    kind = remote("tiny:Inexact", path=(TESTS,))
    first, second = _loaded(kind()), _loaded(kind())
    batch = [tiny.Tiny(None).load(tiny.Tiny(None).samples[0]).observation]
    answers = [method.predict(batch, 0)[0].hypotheses[0] for method in (first, first, second)]
    assert np.array_equal(answers[0].translation, answers[2].translation)
    assert not np.array_equal(answers[0].translation, answers[1].translation)


def test_batch_is_sent_in_one_message(remote):
    method = _loaded(remote("tiny:Shifts", path=(TESTS,))())
    data = tiny.Tiny(None)
    batch = [data.load(ref).observation for ref in data.samples[:3]]
    here = tiny.Shifts()
    here.load(None, "cpu")
    for there, expected in zip(method.predict(batch, 0), here.predict(batch, 0), strict=True):
        assert np.array_equal(there.hypotheses[0].translation, expected.hypotheses[0].translation)


def program(method) -> tuple[dict[str, str], dict[str, str]]:
    run = MethodRun(method(), tiny.Tiny(None))
    return dict(run.provenance), dict(run.files)


def test_other_side_is_identified_by_its_sources(remote, tmp_path):
    for name in ("planted_methods.py", "planted_import.py"):
        shutil.copy(workers.HERE / name, tmp_path / name)
    mark = {workers.MARK: "identified"}
    seen = []
    for change in ("", "", "\n# changed\n"):
        with (tmp_path / "planted_import.py").open("a") as file:
            file.write(change)
        asked = remote("planted_methods:Good", path=(str(tmp_path),), env=mark)
        seen.append(program(asked))
        asked.remote.close()
    (before, _), (same, files), (after, other_files) = seen
    assert before == same
    assert before["code"] != after["code"]
    name = f"{tmp_path.name}/planted_import.py (other side)"
    assert files[name] != other_files[name]
    assert "other side: CPython " in before["packages"]
    assert f"numpy {np.__version__}" in before["packages"]


@pytest.mark.parametrize(
    "change",
    [{"image": "sha256:0123"}, {"env": {"WIDTH": "3"}}, {"command": (sys.executable, "-O")}],
)
def test_other_side_is_identified_by_how_it_is_reached(remote, change):
    mark = {workers.MARK: "reached"}
    before, _ = program(remote("planted_methods:Good", env=mark))
    after, _ = program(
        remote(
            "planted_methods:Good",
            **{"env": {}, **change} | {"env": {**mark, **change.get("env", {})}},
        )
    )
    assert before["code"] != after["code"]


def test_other_side_whose_folders_are_not_told_is_unknown(remote):
    variables = {"PYTHONPATH": str(workers.HERE)}
    facts, _ = program(remote("planted_methods:Good", path=(), env=variables))
    assert facts["code"] == "unknown"


def test_variables_that_its_text_names_belong_to_it(remote, monkeypatch):
    """Which it inherits from here; the text of planted_methods.py has WIDTH, and none has the
    other."""
    mark = {workers.MARK: "variables"}
    seen = []
    for name, value in (("WIDTH", "3"), ("NAMED_BY" + "_NOBODY", "4"), ("WIDTH", "4")):
        monkeypatch.setenv(name, value)
        seen.append(program(remote("planted_methods:Good", env=mark))[0]["code"])
    assert seen[0] == seen[1] != seen[2]


def test_change_while_it_runs_is_seen(remote, tmp_path):
    shutil.copy(workers.HERE / "planted_methods.py", tmp_path)
    method = remote("planted_methods:Good", path=(str(tmp_path),))
    run = MethodRun(method(), tiny.Tiny(None))
    assert not run.changed_meanwhile(thoroughly=True)
    (tmp_path / "weights.bin").write_bytes(b"1")
    assert list(run.changed_meanwhile(thoroughly=True)) == [
        f"{tmp_path.name}/weights.bin (other side) (new)"
    ]


def test_worker_is_python_3_6():
    """Its syntax; that it runs there is shown where such an interpreter is."""
    text = Path(worker_file.__file__).read_text(encoding="utf-8")
    ast.parse(text, feature_version=(3, 6))
    tree = ast.parse(text)
    imported = {
        (node.module if isinstance(node, ast.ImportFrom) else alias.name).partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
    }
    assert imported - sys.stdlib_module_names == {"numpy"}
    # what came later than 3.6, or to numpy later than 1.13
    newer = {"removeprefix", "removesuffix", "fromisoformat", "capture_output", "pidfd_open"}
    newer |= {"waitstatus_to_exitcode", "importlib.metadata", "dataclasses", "default_rng"}
    names = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)} | imported
    assert names & newer == set()


def test_time_is_that_of_the_method_and_its_stages_are_told(remote):
    """Its own; the way there and back is told apart."""
    method = remote("planted_methods:Staged")()
    method.load(None, "cpu")
    observation = tiny.Tiny(None).load(tiny.Tiny(None).samples[0]).observation
    contestant = Contestant(method, [observation] * 2, 0, "cpu")
    start = time.perf_counter()
    told = contestant.examine()
    elapsed = time.perf_counter() - start
    assert told["predictions"] == 2
    assert told["total"] + told["transfer"] <= elapsed
    assert told["total"] >= told["stages"]["network"] >= 0.02
    assert told["transfer"] > 0
    assert told["total"] == method.own_seconds
    assert told["memory"]["host_bytes"] > 2**20
    facts = contestant.facts()
    assert facts["versions"]["interpreter"] == f"CPython {platform.python_version()}"
    assert "numpy" in facts["versions"]
    contestant.close()


def test_a_method_here_has_no_way_to_go():
    method = tiny.Perfect()
    method.load(None, "cpu")
    observation = tiny.Tiny(None).load(tiny.Tiny(None).samples[0]).observation
    assert Contestant(method, [observation], 0, "cpu").examine()["transfer"] is None
