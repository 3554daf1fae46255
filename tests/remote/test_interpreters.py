"""The worker in every other Python that is on this machine, from 3.6 on.

``CPAS_TEST_INTERPRETERS`` names more, separated as in PATH; ``nox -s interpreters`` makes some that
have a numpy of their time.
"""

import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import planted_methods
import pytest
import tiny
import workers
from tapping_here import Here

from pytest_cpas.evaluation import MethodRun
from pytest_cpas.remote import RaisedThereError, remote_method
from pytest_cpas.traces.comparing import compare
from pytest_cpas.traces.files import Header, read_sample, samples_in, write_sample
from pytest_cpas.traces.recording import draws_of, record

NAMES = ("pypy3", *(f"python3.{minor}" for minor in range(6, 20)))


def interpreters() -> dict[str, str]:
    """Those that are named, those of pyenv, those on the path; by what they are called."""
    named = filter(None, os.environ.get("CPAS_TEST_INTERPRETERS", "").split(os.pathsep))
    folder = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    there = sorted(folder.glob("3.*/bin/python"))
    there = [path for path in there if int(path.parts[-3].split(".")[1]) >= 6]
    # pyenv's own commands run whichever version it thinks of
    on_path = [shutil.which(name) for name in NAMES]
    found = [*named, *map(str, there), *(path for path in on_path if path and "shims" not in path)]
    return {str(Path(*Path(path).parts[-3:])): path for path in found}


FOUND = interpreters()


@pytest.mark.parametrize("path", FOUND.values(), ids=list(FOUND))
def test_worker_answers(path, tmp_path):
    """With the method, where there is a numpy; else with what is lacking."""
    asked = workers.spec(command=(path,))
    lacking = ""
    try:
        kind = remote_method(asked)
    except RaisedThereError as error:
        lacking = str(error)
    if lacking:
        # that of another Python, which lies on its path, cannot be imported either
        told = r"(?s)cannot be loaded there: \w+Error: .*numpy.*; the worker needs numpy in"
        assert re.search(told, lacking)
    else:
        run = MethodRun(kind(), tiny.Tiny(None))
        here = planted_methods.Good().right()
        method = run.loaded()
        seen = run.read(run.samples[0]).observation
        [answer] = method.predict([seen, seen], 0)[1].hypotheses
        assert np.array_equal(answer.points, here["points"])
        assert np.array_equal(answer.rotation, here["rotation"])
        assert np.array_equal(answer.extents, here["extents"])
        kind.remote.close()
        check_taps(path, tmp_path)
    assert workers.left_of(asked) == []


def check_taps(path, folder):
    """What is named and drawn there is what is named and drawn by this interpreter; a recorded
    trace of there is replayed here, and one of here there."""
    seen = tiny.Tiny(None).load(tiny.Tiny(None).samples[0]).observation
    traces = []
    for command in (path, sys.executable):
        asked = workers.spec("tapping:Tapping", command=(command,))
        method = remote_method(asked)()
        method.load(None, "cpu")
        traces.append(record(method, [seen], 3))
        method.remote.close()
        assert workers.left_of(asked) == []
    found = compare(*traces)
    assert {each.word for each in found.differences} == {"EXACT"}
    assert not found.only_here
    assert not found.only_there
    header = Header(method="tapping", dataset="tiny", sample="s", category="mug", seed=3)
    write_sample(folder, header, traces[0])
    theirs = read_sample(samples_in(folder)["s"]).trace
    assert compare(record(Here(), [seen], 3), theirs).parting.name == "chosen"
    here = record(Here(), [seen], 3, draws_of(theirs))
    assert {each.word for each in compare(here, theirs, ["chosen"]).differences} == {"EXACT"}
    write_sample(folder, header, record(Here(), [seen], 3))
    ours = read_sample(samples_in(folder)["s"]).trace
    method = remote_method(workers.spec("tapping:Tapping", command=(path,)))()
    method.load(None, "cpu")
    there = record(method, [seen], 3, draws_of(ours))
    method.remote.close()
    assert {each.word for each in compare(there, ours, ["chosen"]).differences} == {"EXACT"}
