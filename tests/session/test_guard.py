"""A run that was asked for does not end with 0 before its verdicts are told, whatever ends it."""

import os
import pty
import select
import signal
import subprocess
import sys
import time

import pytest
from harness import RUN

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="there is a parent on POSIX only")

METHOD = """
import atexit, ctypes, os, signal, sys, threading, time
from tiny import *

class Ends(Perfect):
    def load(self, assets, device):
        super().load(assets, device)
        if {load!r}:
            exec({load!r})

    def predict(self, batch, seed):
        if {predict!r}:
            exec({predict!r})
        return super().predict(batch, seed)
"""

NAMES = ("--cpas-method=ends:Ends", "--cpas-dataset=tiny:Tiny", "--cpas-limit=4")


@pytest.fixture
def ends(cpas, pytester):
    """Run a method that ends the process, or beside a conftest that does."""

    def run(*args, load="", predict="", module="", conftest="", plugin="", names=NAMES):
        code = METHOD.format(load=load, predict=predict) + module
        pytester.makepyfile(ends=code)
        if conftest:
            pytester.makeconftest("import os, sys, pytest\n" + conftest)
        if plugin:
            pytester.makepyfile(planted="import os, sys, pytest\n" + plugin)
            args = (*args, "-p", "planted")
        return pytester.runpytest_subprocess(*RUN, *names, *args)

    return run


EXITS = {
    "_exit": "os._exit(0)",
    "C exit": "ctypes.CDLL(None).exit(0)",
    "exec": "os.execv(sys.executable, [sys.executable, '-c', ''])",
    "thread": "threading.Thread(target=os._exit, args=[0]).start(); time.sleep(30)",
    "handler": "signal.signal(signal.SIGALRM, lambda *_: os._exit(0)); signal.alarm(1);"
    " time.sleep(30)",
    "copy goes on": "pid = os.fork()\nif pid: os.waitpid(pid, 0); os._exit(0)",
    "copy is left": "if os.fork(): os._exit(0)\nelse: time.sleep(1)",
    "sys.exit": "sys.exit(0)",
    "SystemExit": "raise SystemExit",
    "pytest.exit": "import pytest; pytest.exit('enough', returncode=0)",
}


@pytest.mark.thinned(3)
@pytest.mark.parametrize("where", ["load", "predict"])
@pytest.mark.parametrize("how", EXITS)
def test_method_that_ends_the_process(ends, how, where):
    result = ends(**{where: EXITS[how]})
    assert result.ret == 1
    if how not in ("sys.exit", "SystemExit", "pytest.exit"):
        result.stderr.fnmatch_lines(
            [
                "ERROR: the process of pytest ended with exit status 0 after cpas::test_*[[]*"
                " had begun; no verdict was told. *; the exit status is 1, not 0"
            ]
        )


@pytest.mark.parametrize("where", ["load", "predict"])
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGSEGV])
def test_signal_is_the_end_of_the_command_as_well(ends, number, where):
    result = ends(**{where: f"os.kill(os.getpid(), {number:d})"})
    assert result.ret == -number
    result.stderr.fnmatch_lines([f"ERROR: pytest was ended by {number.name}* after cpas::test_*"])


@pytest.mark.parametrize("limit", [(), ("--cpas-timeout=60",)], ids=["", "limit"])
def test_method_that_closes_what_it_has_not_opened(ends, limit):
    """pytest's own output is lost with its descriptors; the parent says why."""
    result = ends(*limit, predict="os.closerange(3, 256)")
    assert result.ret not in (0, 5)
    result.stderr.fnmatch_lines(
        ["ERROR: descriptors that pytest prints to were closed after cpas::test_* had begun, so *"]
    )


def test_interrupted_run_is_no_lost_output(ends):
    """pytest closes its own descriptors when it is interrupted."""
    result = ends(predict="raise KeyboardInterrupt")
    assert result.ret == 2
    result.stderr.no_fnmatch_line("*ERROR*")


def test_parent_that_was_stopped_goes_on(started):
    process = started(predict="open('waits', 'w').close(); os.kill(os.getppid(), signal.SIGSTOP)")
    output = process.communicate(timeout=60)[0].decode()
    assert process.returncode == 0, output


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of such a death")
@pytest.mark.parametrize("end", ["os._exit(0)", "os.execv('/bin/true', ['true'])"])
def test_parent_that_was_stopped_hears_of_the_end(started, end):
    stops = "open('waits', 'w').close(); os.kill(os.getppid(), signal.SIGSTOP)"
    process = started(predict=f"{stops}; {end}")
    output = process.communicate(timeout=60)[0].decode()
    assert process.returncode == 1, output
    assert "the process of pytest ended with exit status 0" in output


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of such a death")
def test_process_that_watches_and_was_killed_is_told(ends):
    kills = (
        "[os.kill(int(p), 9) for p in os.listdir('/proc') if p.isdigit() and os.getpgid(int(p))"
        " == os.getpgrp() and b'watching.py' in open(f'/proc/{p}/cmdline', 'rb').read()]"
    )
    result = ends("--cpas-timeout=60", predict=f"{kills}; time.sleep(60)")
    assert result.ret != 0
    result.stderr.fnmatch_lines(
        ["ERROR: the process that watches the time of calls was ended, and pytest with it after *"]
    )


@pytest.mark.parametrize("status", [3, 9])
def test_other_status_is_kept(ends, status):
    result = ends(predict=f"os._exit({status})")
    assert result.ret == status
    result.stderr.fnmatch_lines([f"ERROR: * ended with exit status {status} after cpas::test_*"])


@pytest.mark.parametrize("code", ["os._exit(0)", "sys.exit(0)", "raise SystemExit"])
def test_method_that_cannot_be_imported(ends, code):
    assert ends(module=code).ret not in (0, 5)


@pytest.mark.parametrize(
    "code",
    [
        "atexit.register(os._exit, 0)",
        "threading.Thread(target=lambda: (threading.main_thread().join(), os._exit(0))).start()",
    ],
)
def test_end_after_a_bad_verdict(ends, code):
    result = ends(load=code, predict="raise RuntimeError")
    assert result.ret == 1
    result.stderr.fnmatch_lines(["ERROR: * exit status 0 after pytest had given 1*"])


#: What a conftest.py can do to a run before its verdicts are told.
BEFORE = {
    "import: _exit": "os._exit(0)",
    "import: sys.exit": "sys.exit(0)",
    "import: pytest.exit": "pytest.exit('enough', returncode=0)",
    "cmdline: _exit": "def pytest_cmdline_main(): os._exit(0)",
    "cmdline: sys.exit": "def pytest_cmdline_main(): sys.exit(0)",
    "cmdline: 0": "def pytest_cmdline_main(): return 0",
    "configure: sys.exit": "def pytest_configure(): sys.exit(0)",
    "configure: pytest.exit": "def pytest_configure(): pytest.exit('enough', returncode=0)",
    "start: unregister": "def pytest_sessionstart(session):\n"
    "  session.config.pluginmanager.unregister(name='cpas-session')",
    "start: pytest.exit": "def pytest_sessionstart(): pytest.exit('enough', returncode=0)",
    "collection: none": "def pytest_collection(): return True",
    "collection: empty": "def pytest_collection_modifyitems(items): items.clear()",
    "collection: pytest.exit": "def pytest_collection(): pytest.exit('enough', returncode=0)",
    "loop: _exit": "def pytest_runtestloop(): os._exit(0)",
    "loop: sys.exit": "def pytest_runtestloop(): sys.exit(0)",
    "loop: True": "def pytest_runtestloop(): return True",
    "loop: pytest.exit": "def pytest_runtestloop(): pytest.exit('enough', returncode=0)",
    "loop: forgets items": "@pytest.hookimpl(wrapper=True)\n"
    "def pytest_runtestloop(session): del session.items[9:]; return (yield)",
    "loop: does not yield": "@pytest.hookimpl(wrapper=True)\n"
    "def pytest_runtestloop(session):\n  if 0: yield\n  return True",
    "protocol: True": "def pytest_runtest_protocol(item): return True",
    "finish: _exit": "def pytest_sessionfinish(): os._exit(0)",
    "finish: sys.exit": "def pytest_sessionfinish(): sys.exit(0)",
    "finish: pytest.exit": "def pytest_sessionfinish(): pytest.exit('enough', returncode=0)",
    "summary: _exit": "def pytest_terminal_summary(): os._exit(0)",
    "summary: pytest.exit": "def pytest_terminal_summary(): pytest.exit('enough', returncode=0)",
}


@pytest.mark.parametrize("what", BEFORE)
def test_conftest_that_ends_a_run(ends, what):
    result = ends(conftest=BEFORE[what])
    assert result.ret not in (0, 5)
    assert result.stdout.str() + result.stderr.str()


#: The same, once verdicts are told, and which.
LATE = {
    "summary": (
        "def pytest_terminal_summary(): os._exit(0)",
        "its verdicts were told, but it had*",
    ),
    "finish": ("def pytest_sessionfinish(): os._exit(0)", "its verdicts were told, but it had*"),
    "first verdict": (
        "def pytest_runtest_logfinish(nodeid):\n  if 'golden[' in nodeid: os._exit(0)",
        "not all verdicts were told.*",
    ),
}


@pytest.mark.parametrize("when", LATE)
def test_what_was_told_before_the_end_is_not_denied(ends, when):
    conftest, words = LATE[when]
    result = ends(conftest=conftest)
    assert result.ret == 1
    result.stderr.fnmatch_lines([f"ERROR: the process of pytest ended with * begun; {words}"])


#: What only a plugin can do: a conftest.py does not see the items of the suite that ships.
ITEMS = {
    "teardown: _exit": "def pytest_runtest_teardown(): os._exit(0)",
    "teardown: pytest.exit": "def pytest_runtest_teardown(): pytest.exit('enough', returncode=0)",
    "report: pytest.exit": "def pytest_runtest_logreport(): pytest.exit('enough', returncode=0)",
    "loop: swallows": "@pytest.hookimpl(wrapper=True)\ndef pytest_runtestloop():\n"
    "  try: yield\n  except KeyboardInterrupt: pass\n  return True\n"
    "def pytest_runtest_teardown(): raise KeyboardInterrupt",
    "protocol: True": "def pytest_runtest_protocol(): return True",
}


@pytest.mark.parametrize("what", ITEMS)
def test_plugin_that_ends_a_run(ends, what):
    assert ends(plugin=ITEMS[what]).ret == 1


#: What it can do after they are.
AFTER = {
    "finish: status": "@pytest.hookimpl(trylast=True)\n"
    "def pytest_sessionfinish(session): session.exitstatus = 0",
    "finish: outer status": "@pytest.hookimpl(wrapper=True, tryfirst=True)\n"
    "def pytest_sessionfinish(session): yield; session.exitstatus = 0",
    "cmdline: wrapper": "@pytest.hookimpl(wrapper=True)\n"
    "def pytest_cmdline_main(): yield; return 0",
    "cmdline: outer wrapper": "@pytest.hookimpl(wrapper=True, tryfirst=True)\n"
    "def pytest_cmdline_main(): yield; return 0",
    "cmdline: outer _exit": "@pytest.hookimpl(wrapper=True, tryfirst=True)\n"
    "def pytest_cmdline_main(): yield; os._exit(0)",
    "unconfigure: _exit": "def pytest_unconfigure(): os._exit(0)",
    "unconfigure: sys.exit": "def pytest_unconfigure(): sys.exit(0)",
    "unconfigure: pytest.exit": "def pytest_unconfigure(): pytest.exit('enough', returncode=0)",
}


@pytest.mark.parametrize("what", AFTER)
def test_conftest_that_hides_a_bad_verdict(ends, what):
    assert ends(conftest=AFTER[what], predict="raise RuntimeError").ret == 1


def test_own_tests_that_fail_hide_nothing(ends, pytester):
    own = pytester.makepyfile(test_own="def test_own(): assert False")
    planted = {"conftest": AFTER["finish: status"]}
    result = ends(own, **planted, predict="raise RuntimeError")
    assert result.ret == 1
    result.stderr.fnmatch_lines(["ERROR: cpas::test_contract* failed, and a plugin made that a *"])
    # what a project does with the status of its own tests is its own business
    assert ends(own, **planted).ret == 0


@pytest.mark.parametrize("what", AFTER)
def test_good_verdict_that_was_told_stays_good(ends, what):
    # an exception out of pytest_unconfigure is an error with or without us
    assert ends(conftest=AFTER[what]).ret == (1 if what == "unconfigure: pytest.exit" else 0)


def test_plugins_and_options_of_the_environment(ends, pytester, monkeypatch):
    leaves = "def pytest_runtestloop(): os._exit(0)"
    monkeypatch.setenv("PYTEST_ADDOPTS", " ".join(NAMES))
    assert ends(names=(), plugin=leaves).ret == 1
    pytester.makepyfile(ends_at_once="import os\nos._exit(0)")
    monkeypatch.setenv("PYTEST_PLUGINS", "ends_at_once")
    assert ends(names=()).ret == 1
    monkeypatch.delenv("PYTEST_PLUGINS")
    monkeypatch.delenv("PYTEST_ADDOPTS")
    pytester.makeini(f"[pytest]\naddopts = {' '.join(NAMES)}")
    assert ends(names=(), plugin=leaves).ret == 1


XDIST = {
    "_exit in predict": {"predict": "os._exit(0)"},
    "C exit in load": {"load": "ctypes.CDLL(None).exit(0)"},
    "sys.exit in predict": {"predict": "sys.exit(0)"},
    "exec in predict": {"predict": EXITS["exec"]},
    "SIGKILL in predict": {"predict": "os.kill(os.getpid(), signal.SIGKILL)"},
    "import": {"module": "if 'PYTEST_XDIST_WORKER' in os.environ: os._exit(0)"},
    "import: sys.exit": {"module": "if 'PYTEST_XDIST_WORKER' in os.environ: sys.exit(0)"},
    "worker's loop": {
        "conftest": "@pytest.hookimpl(tryfirst=True)\ndef pytest_runtestloop(session):\n"
        "  if hasattr(session.config, 'workerinput'): return True"
    },
    "worker's loop: _exit": {
        "conftest": "@pytest.hookimpl(tryfirst=True)\ndef pytest_runtestloop(session):\n"
        "  if hasattr(session.config, 'workerinput'): os._exit(0)"
    },
    "worker forgets items": {"conftest": BEFORE["loop: forgets items"]},
    "controller: report": {
        "conftest": "def pytest_runtest_logreport(report):\n"
        "  if 'PYTEST_XDIST_WORKER' not in os.environ: os._exit(0)"
    },
    "controller: collection": {
        "conftest": "def pytest_xdist_node_collection_finished(): os._exit(0)"
    },
    "controller: finish": {
        "conftest": "def pytest_sessionfinish(session):\n"
        "  if not hasattr(session.config, 'workerinput'): os._exit(0)"
    },
    "controller: exit": {
        "conftest": "def pytest_runtest_logreport(report):\n"
        "  if 'PYTEST_XDIST_WORKER' not in os.environ: pytest.exit('enough', returncode=0)"
    },
}


@pytest.mark.thinned(4)
@pytest.mark.parametrize("what", XDIST)
def test_workers_and_their_controller(ends, what):
    result = ends("-n2", **XDIST[what])
    assert result.ret not in (0, 5)


@pytest.mark.parametrize("code", ["os._exit(0)", "sys.exit(0)"])
@pytest.mark.parametrize(
    "asked",
    [
        ("--cpas-metrics=cpas", "--cpas-examples=1"),
        ("--cpas-check-dataset=tiny:Tiny",),
        ("--cpas-predictions=nowhere.npz",),
        (*NAMES, "--cpas-benchmark"),
    ],
    ids=lambda options: options[-1],
)
def test_every_kind_of_run_is_guarded(ends, asked, code):
    assert ends(conftest=f"def pytest_cmdline_main(): {code}", names=asked).ret == 1


def test_merge_is_guarded(ends, pytester):
    assert ends("--cpas-results=out").ret == 0
    pytester.makeconftest("import os\ndef pytest_runtestloop(): os._exit(0)")
    command = (sys.executable, "-m", "pytest_cpas.cli", "merge", "out/ends-tiny.jsonl")
    (file,) = (pytester.path / "out").iterdir()
    result = pytester.run(*command[:-1], file, *RUN)
    assert result.ret == 1
    result.stderr.fnmatch_lines(["ERROR: the process of pytest ended with exit status 0 *"])


#: What runs nothing, and whether our sessions are there to say so.
SHOWS = {
    "--collect-only": True,
    "--fixtures": True,
    "--fixtures-per-test": True,
    "--cache-show": True,
    "--setup-only": True,
    "--setup-plan": True,
    "--help": False,
    "--markers": False,
    "--version": False,
    "--cpas-list": False,
}


@pytest.mark.parametrize("option", SHOWS)
def test_what_only_shows_something_tells_no_verdict(cpas, pytester, option):
    run = ("-p", "cacheprovider", "--cpas-metrics=cpas", "--cpas-require-golden")
    update = () if option == "--setup-plan" else ("--snapshot-update",)
    result = cpas("Perfect", option, *run, *update, "--cpas-results=out", "--cpas-report=report")
    output = result.stdout.str()
    assert result.ret == 0
    assert output.count("nothing was run, so no verdict is told") == 2 * SHOWS[option]
    for word in ("samples judged", "rows:", "golden:", "contract:", "RECORDED", "passed"):
        assert SHOWS[option] == 0 or word not in output
    left = {path.name for path in pytester.path.iterdir()}
    assert left.isdisjoint({"out", "report"})
    assert not [*pytester.path.glob("golden/*")]


def test_a_selection_without_any_item_is_no_success(ends):
    result = ends("-k", "no_such_item")
    assert result.ret == 1
    result.stderr.fnmatch_lines(["ERROR: no item of the run that was asked for was collected *"])


# -- what stays as it was -------------------------------------------------------------------------

PROCESS = """
import os
def test_process():
    with open("pids", "w") as file:
        file.write(f"{os.getpid()} {os.getppid()}")
"""


@pytest.mark.parametrize("asked", [(), NAMES], ids=["own tests", "run"])
def test_no_process_is_made_for_other_runs(ends, pytester, asked):
    ends(names=("--version",))
    file = pytester.makepyfile(test_own=PROCESS)
    with subprocess.Popen(
        [sys.executable, "-m", "pytest", *RUN, *asked, file], stdout=subprocess.DEVNULL
    ) as process:
        pass
    own, parent = map(int, (pytester.path / "pids").read_text().split())
    assert process.returncode == 0
    assert (own == process.pid) == (not asked)
    assert (parent == process.pid) == bool(asked)


def test_a_program_that_calls_pytest_is_not_doubled(ends, pytester):
    ends(names=("--version",))
    pytester.makepyfile(test_own=PROCESS)
    program = f"""
        import os, sys, pytest
        options = [*{RUN!r}, *{NAMES!r}]
        assert pytest.main([*options, "test_own.py"]) == 0
        assert open("pids").read().split()[0] == str(os.getpid())
        open("conftest.py", "w").write("import sys\\nsys.exit(0)")
        assert pytest.main(options) == 4
        open("conftest.py", "w").write("def pytest_cmdline_main(): raise SystemExit")
        sys.modules.pop("conftest", None)
        assert pytest.main(options) == 1
        print("through")
    """
    result = pytester.runpython(pytester.makepyfile(program=program))
    assert result.ret == 0
    assert result.stdout.str().count("through") == 1


def test_a_test_that_calls_pytest_is_not_doubled(ends, pytester):
    ends(names=("--version",))
    file = pytester.makepyfile(
        f"""
        import os, pytest
        def test_nested():
            before = os.getpid()
            assert pytest.main([*{RUN!r}, *{NAMES!r}, "--cpas-require-golden"]) == 1
            assert os.getpid() == before
        """
    )
    assert pytester.runpytest_subprocess(*RUN, file).ret == 0


def test_what_was_printed_before_is_printed_once(ends):
    result = ends(plugin="print('loaded', end=' ')")
    assert result.ret == 0
    assert result.stdout.str().count("loaded") == 1


def test_process_that_is_left_behind_is_not_waited_for(ends):
    began = time.monotonic()
    result = ends(
        load="import subprocess; subprocess.Popen([sys.executable, '-c', SLEEP])",
        module="SLEEP = 'import time; time.sleep(60)'",
    )
    assert result.ret == 0
    assert time.monotonic() - began < 50


@pytest.fixture
def started(ends, pytester):
    """Start a run that waits in ``predict``; in a process group of its own."""
    processes = []

    def start(*args, predict="open('waits', 'w').close(); time.sleep(60)", **options):
        ends(names=("--version",), predict=predict)
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *RUN, *NAMES, *args],
            start_new_session=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            preexec_fn=_hears,
            **options,
        )
        processes.append(process)
        _until((pytester.path / "waits").exists)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


def _hears():
    """What a shell runs in the background, or nohup, ignores these, and so would the run."""
    for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def _until(happened):
    for _ in range(600):
        if happened():
            return
        time.sleep(0.05)
    raise AssertionError("nothing happened in 30 s")


def _gone(group):
    """Whether no process of the group runs."""
    found = subprocess.run(["ps", "-o", "stat=", "-g", str(group)], capture_output=True, text=True)
    return all(state.startswith("Z") for state in found.stdout.split())


@pytest.mark.parametrize("kill", [os.kill, os.killpg])
def test_interrupt(started, kill):
    process = started()
    kill(process.pid, signal.SIGINT)
    output = process.communicate()[0].decode()
    assert process.returncode == 2, output
    assert output.count("! KeyboardInterrupt !") == 1
    assert "ERROR" not in output
    assert _gone(process.pid)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1])
def test_signal_is_handed_on(started, number):
    process = started()
    process.send_signal(number)
    assert f"pytest was ended by {number.name}" in process.communicate()[0].decode()
    assert process.returncode == -number
    assert _gone(process.pid)


def test_handler_of_a_method_is_called(started):
    process = started(
        predict="if not os.path.exists('waits'):\n"
        "  signal.signal(signal.SIGTERM, lambda *_: sys.exit(5))\n"
        "  open('waits', 'w').close(); time.sleep(60)"
    )
    process.terminate()
    assert b"SystemExit: 5" in process.communicate()[0]
    assert process.returncode == 1


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process of such a death")
def test_nothing_is_left_when_the_parent_is_killed(started):
    process = started()
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    _until(lambda: _gone(process.pid))


# -- in a terminal --------------------------------------------------------------------------------

#: A shell of one job, which says how it stopped and ended.
SHELL = """
import os, signal, sys
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
job = os.fork()
if not job:
    os.setpgid(0, 0)
    os.tcsetpgrp(0, os.getpid())
    signal.signal(signal.SIGTTOU, signal.SIG_DFL)
    os.execv(sys.executable, [sys.executable, "-m", "pytest", *sys.argv[1:]])
while True:
    _, status = os.waitpid(job, os.WUNTRACED)
    os.tcsetpgrp(0, os.getpgrp())
    if not os.WIFSTOPPED(status):
        break
    print("stopped by", os.WSTOPSIG(status), flush=True)
    sys.stdin.readline()
    os.tcsetpgrp(0, job)
    os.killpg(job, signal.SIGCONT)
print("ended with", os.waitstatus_to_exitcode(status), flush=True)
"""


@pytest.fixture
def terminal(ends, pytester):
    """Talk with a run in a terminal: pairs of what is waited for and what is typed then."""

    def talk(*pairs, args=(), **planted):
        ends(names=("--version",), **planted)
        shell = pytester.makepyfile(shell=SHELL)
        pid, screen = pty.fork()
        if not pid:
            _hears()
            os.chdir(pytester.path)
            os.execv(sys.executable, [sys.executable, shell, *RUN, *NAMES, "--color=no", *args])
        text, since = "", 0
        for awaited, typed in (*pairs, ("ended with", "")):
            while awaited not in text[since:]:
                assert select.select([screen], [], [], 60)[0], text
                try:
                    text += os.read(screen, 4096).decode(errors="replace")
                except OSError:
                    raise AssertionError(f"no {awaited!r} in:\n{text}") from None
            since = text.index(awaited, since) + len(awaited)
            os.write(screen, typed.encode())
        while select.select([screen], [], [], 10)[0]:
            try:
                text += os.read(screen, 4096).decode(errors="replace")
            except OSError:
                break
        os.close(screen)
        os.waitpid(pid, 0)
        return text

    return talk


WAITS = "print('wai' + 'ting', flush=True); time.sleep(60)"


def test_interrupt_from_a_terminal(terminal):
    text = terminal(("waiting", "\x03"), args=["-s"], predict=WAITS)
    assert "ended with 2" in text
    assert text.count("! KeyboardInterrupt !") == 1
    assert "ERROR" not in text


def test_quit_from_a_terminal(terminal):
    text = terminal(("waiting", "\x1c"), args=["-s"], predict=WAITS)
    assert f"ended with {-signal.SIGQUIT}" in text
    assert "pytest was ended by SIGQUIT" in text


def test_job_is_stopped_and_goes_on(terminal):
    predict = "if not os.path.exists('x'): open('x', 'w'); print('wai' + 'ting', flush=True)\n"
    text = terminal(
        ("waiting", "\x1a"),
        (f"stopped by {signal.SIGTSTP:d}", "go on\n"),
        args=["-s"],
        predict=predict + "time.sleep(0.2)",
    )
    assert "ended with 0" in text
    assert "4 of 12 samples judged" in text


def test_debugger_reads_from_the_terminal(terminal):
    text = terminal(
        ("(Pdb) ", "p 6 * 7\n"),
        ("42", ""),
        ("(Pdb) ", "c\n"),
        predict="if not os.path.exists('x'): open('x', 'w'); breakpoint()",
    )
    assert "ended with 0" in text


@pytest.mark.parametrize("typed", ["q\n", "\x04"], ids=["q", "end of file"])
def test_post_mortem_debugger(terminal, typed):
    text = terminal(("(Pdb) ", typed), args=["--pdb"], predict="raise RuntimeError('planted')")
    assert "ended with 2" in text
    assert "planted" in text
