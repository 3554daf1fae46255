"""Commands that lead into a container and to another host, through stand-ins that do what they do.

``docker run`` is another root folder, another user, no environment and processes of its own, whose
client can be killed without them; ``ssh`` joins its words for a shell in another folder, which
greets whoever comes.
"""

import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
import workers

from pytest_cpas.evaluation import Limit, MethodRun, Row, SampleError, Watchdog
from pytest_cpas.remote import named_methods, remote_method

DOCKER = """#!/bin/sh
while [ "$1" != image ]; do shift; done
shift
exec unshare --user --map-root-user --mount --propagation private --pid --fork --mount-proc sh -c '
    mount -t tmpfs none /mnt && mkdir /mnt/code /mnt/weights &&
    mount --bind "$CODE" /mnt/code && mount --bind "$WEIGHTS" /mnt/weights &&
    mount -t tmpfs none "$HIDDEN" && cd / &&
    exec env -i CPAS_TEST_WORKER=$CPAS_TEST_WORKER "$@"' sh "$@"
"""

SSH = """#!/bin/sh
[ "$1" = host ] || exit 255
shift
cd "$HOME_THERE"
echo "Welcome to host. 2 updates can be applied"
echo "Authorised use alone" >&2
exec env -i CPAS_TEST_WORKER=$CPAS_TEST_WORKER sh -c "$*"
"""

METHODS = """
[docker]
command = ["{docker}", "run", "-i", "--rm", "image", "{python}"]
class = "planted_methods:{cls}"
path = ["code"]
paths = {{ "/mnt/code" = "code", "/mnt/weights" = "weights" }}
env = {{ {mark} = "{value}", WIDTH = "3" }}

[ssh]
command = ["{ssh}", "host", "{python}"]
class = "planted_methods:{cls}"
path = ["code"]
paths = {{ "{home}/code" = "code", "{home}/weights" = "weights" }}
env = {{ {mark} = "{value}", WIDTH = "3" }}
"""


@functools.cache
def may_unshare() -> bool:
    command = ["unshare", "--user", "--map-root-user", "--mount", "--pid", "--fork", "true"]
    try:
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        return False


@pytest.fixture(params=["docker", "ssh"])
def elsewhere(request, tmp_path, monkeypatch):
    """Makes a method of a container or a host; sees that no process is left there or here."""
    if request.param == "docker" and not may_unshare():
        pytest.skip("this system lets nobody make a root folder of its own")
    project, home = tmp_path / "project", tmp_path / "home"
    for folder in (project / "code", project / "weights", home):
        folder.mkdir(parents=True)
    shutil.copy(workers.HERE / "planted_methods.py", project / "code")
    (project / "weights" / "w.bin").write_bytes(b"weights")
    shutil.copytree(project / "code", home / "code")
    shutil.copytree(project / "weights", home / "weights")
    for name, text in (("docker", DOCKER), ("ssh", SSH)):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    asked = workers.spec()
    variables = {
        "CODE": project / "code",
        "WEIGHTS": project / "weights",
        "HIDDEN": tmp_path,
        "HOME_THERE": home,
        "ONLY_HERE": "1",
    }
    for name, value in variables.items():
        monkeypatch.setenv(name, str(value))

    def make(cls: str, seconds: float = 20.0) -> MethodRun:
        values = {"docker": tmp_path / "docker", "ssh": tmp_path / "ssh", "home": home, "cls": cls}
        mark = {"mark": workers.MARK, "value": asked.env[workers.MARK], "python": sys.executable}
        (project / "cpas-methods.toml").write_text(METHODS.format(**values, **mark))
        kind = remote_method(named_methods(project)[request.param])
        made.append(kind)
        run = MethodRun(kind(), tiny.Tiny(None), weights=project / "weights")
        run.limit = Limit(watchdog=Watchdog(), seconds=seconds)
        return run

    made = []
    yield make
    for kind in made:
        kind.remote.close()
    assert workers.left_of(asked) == []


def judged(run: MethodRun, count: int) -> list[Row | str]:
    found = []
    for ref in run.samples[:count]:
        try:
            found.append(run.judge(ref))
        except SampleError as error:
            found.append(str(error))
    return found


def test_method_finds_its_weights_and_variables_there_and_nothing_of_here(elsewhere):
    run = elsewhere("Elsewhere")
    assert [type(each) for each in judged(run, 2)] == [Row, Row]
    assert run.provenance["code"] != "unknown"
    assert "code/planted_methods.py (other side)" in run.files


def test_its_death_is_told_as_it_was_there(elsewhere):
    """Neither client would tell the signal."""
    before, died, after = judged(elsewhere("Crashes"), 3)
    assert "the worker died (signal 11, SIGSEGV); it printed last:" in died
    assert "CUDA error: an illegal memory" in died
    assert isinstance(before, Row)
    assert isinstance(after, Row)


def test_it_is_ended_there_when_its_time_is_over(elsewhere):
    before, late, after = judged(elsewhere("HoldsTheLock", 0.4), 3)
    assert "predict took longer than 0.4 s, so the worker was ended; it printed last:" in late
    assert "in fault" in late
    assert isinstance(before, Row)
    assert isinstance(after, Row)


def test_folders_of_here_are_hidden_there(elsewhere):
    """Or these tests would show nothing of maps of folders."""
    run = elsewhere("Elsewhere")
    assert not Path("/mnt/code").exists()
    there = run.unloaded.remote.spec.path[0]
    assert there != str(Path(os.environ["CODE"]))
