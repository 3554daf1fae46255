"""A new user makes an adapter and goes where its sentences lead."""

import ast
import sys

import pytest
from harness import RUN

from pytest_cpas._files import cache_folder
from pytest_cpas.cli import main

#: The user's, before pytester gives each test a home of its own: the data set is made there once.
CACHE = cache_folder()


@pytest.fixture
def skeleton(pytester, monkeypatch):
    """A fresh adapter; gives a function that runs pytest beside it, as a user would."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.setenv("CPAS_CACHE", str(CACHE))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")  # edits may come within a second
    assert main(["new-adapter", "my-method"]) == 0
    return lambda *args: pytester.runpytest_subprocess(*RUN, "-q", *args)


CPAS = ("--cpas-method=my_method:MyMethod", "--cpas-dataset=synthetic-handheld", "--cpas-limit=24")


def edit(pytester, **changes):
    path = pytester.path / "my_method.py"
    text = path.read_text()
    for old, new in changes.values():
        assert old in text
        text = text.replace(old, new)
    path.write_text(text)


def test_the_skeleton_runs_at_once(skeleton):
    result = skeleton(*CPAS)
    assert result.ret == 0
    result.stdout.fnmatch_lines(
        ["contract: *", "24 of 126 samples judged", "*record them with --snapshot-update"]
    )
    result.stdout.no_fnmatch_line("*violated*")
    assert skeleton(*CPAS, "--cpas-require-golden").ret == 1


def test_the_next_command_is_printed(pytester, capsys):
    assert main(["new-adapter", "my-method", "--to", "some where"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == (
        "  cd 'some where' && pytest --cpas-method=my_method:MyMethod"
        " --cpas-dataset=synthetic-handheld --cpas-limit=24"
    )


def test_its_own_test_says_what_to_do(skeleton):
    result = skeleton("test_my_method.py")
    result.assert_outcomes(passed=23, failed=1)
    result.stdout.fnmatch_lines(
        [
            "correct at 10 deg, 2 cm: all */36, bottle */6, *",
            "No usual mistake explains it: go on with the TODOs of my_method.py.",
            "Each sample's errors: pytest --cpas-method=my_method:MyMethod *--cpas-limit=20",
            "Once it is as good as it should be, record it: pytest *--snapshot-update",
        ]
    )


def test_millimetres_stop_at_the_contract(skeleton, pytester):
    edit(pytester, unit=("(low + high) / 2", "500 * (low + high)"))
    result = skeleton(*CPAS)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["the adapter is wrong*metric_units*looks like millimetres*"])


#: A method that knows the truth, in NOCS's axes.
ORACLE = {
    "import": (
        "import numpy as np",
        "import numpy as np\n\nfrom pytest_cpas.datasets.synthetic import SyntheticHandheld",
    ),
    "load": (
        '        """Called once.',
        "        dataset = SyntheticHandheld(None)\n"
        "        samples = [dataset.load(ref) for ref in dataset.samples]\n"
        "        self.truths = {s.observation.mask.tobytes(): s.truth for s in samples}\n"
        '        """Called once.',
    ),
    "answer": (
        "        points = observation",
        "        truth = self.truths[observation.mask.tobytes()]\n"
        "        axes = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])\n"
        "        rotation, translation = truth.pose.rotation @ axes, truth.pose.translation\n"
        "        extents = truth.extents[[2, 1, 0]]\n"
        "        parts = dict(rotation=rotation, translation=translation, extents=extents)\n"
        "        return Prediction((Hypothesis(**parts),))\n"
        "        points = observation",
    ),
}


def test_another_object_frame_is_named_and_the_line_to_change_helps(skeleton, pytester):
    edit(pytester, **ORACLE)
    wrong = skeleton("test_my_method.py", "-k", "half")
    wrong.assert_outcomes(failed=1, deselected=23)
    wrong.stdout.fnmatch_lines(
        [
            "your object frame is NOCS's, not ShapeNet's: *",
            '  change: object_frame="nocs" in MethodInfo',
        ]
    )
    edit(pytester, frame=('object_frame="shapenet"', 'object_frame="nocs"'))
    skeleton("test_my_method.py", "-k", "half").assert_outcomes(passed=1, deselected=23)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("My Method", "expected small letters"),
        ("../up", "expected small letters"),
        ("-x", None),
        ("", "expected small letters"),
        ("class", "python has class already"),
        ("json", "python has json already"),
        ("pytest-cpas", "python has pytest_cpas already"),
        ("icp", "a method of that name is registered"),
    ],
)
def test_names_that_are_refused(pytester, capsys, name, words):
    if words is None:  # argparse takes it for an option
        with pytest.raises(SystemExit):
            main(["new-adapter", name])
    else:
        assert main(["new-adapter", name, "--to", str(pytester.path / "new")]) == 1
        assert words in capsys.readouterr().err
    assert not (pytester.path / "new").exists()


@pytest.mark.parametrize("file", ["my_method.py", "test_my_method.py", "my-method.known.toml"])
def test_nothing_is_overwritten(pytester, capsys, file):
    (pytester.path / file).write_text("mine")
    assert main(["new-adapter", "my-method", "--to", str(pytester.path)]) == 1
    assert f"{file}: there already; nothing was written" in capsys.readouterr().err
    assert [path.name for path in pytester.path.iterdir()] == [file]
    assert (pytester.path / file).read_text() == "mine"


def test_an_adapter_for_another_interpreter_answers_at_once(pytester, capsys, monkeypatch):
    """Its own Python stands for the other one; nothing of pytest-cpas is imported there."""
    assert main(["new-adapter", "my-method", "--for-interpreter", "3.6"]) == 0
    written, _, told = capsys.readouterr().out.partition("next:\n")
    assert written.split() == ["wrote", "my_method.py", "cpas-methods.toml", "my-method.known.toml"]
    assert told.split("\n")[0] == "  pytest-cpas worker-check my-method"
    text = (pytester.path / "my_method.py").read_text()
    assert "pytest_cpas" not in text
    # nothing names a test that is not there
    assert "test_my_method" not in (pytester.path / "my-method.known.toml").read_text()
    ast.parse(text, feature_version=(3, 6))
    file = pytester.path / "cpas-methods.toml"
    file.write_text(file.read_text().replace('["python3.6"]', f"[{sys.executable!r}]"))
    assert main(["worker-check", "my-method"]) == 0
    fnmatch_lines(
        capsys.readouterr().out,
        "my-method: *python*",
        "  CPython * on this machine, my_method:MyMethod in * s",
        "  bottle, bowl, camera and 3 more; needs depth; gives pose, extents; licence unknown",
        "  its sources are known, so that its rows are reused while they stay the same",
        "  a made-up bottle 0.7 m away: answered at (*0.00, *0.00, 0.6*) m of the camera, *",
        "  pytest --cpas-method=my-method --cpas-dataset=synthetic-handheld --cpas-limit=24",
    )


@pytest.mark.parametrize("version", ["3.5", "2.7", "3", "four"])
def test_an_interpreter_that_no_worker_runs_in(pytester, capsys, version):
    assert main(["new-adapter", "my-method", "--for-interpreter", version]) == 1
    assert f"--for-interpreter {version}: expected a version" in capsys.readouterr().err
    assert list(pytester.path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("icp", "is one of this interpreter: pytest --cpas-method=icp runs it"),
        ("icq", "unknown method 'icq'. Did you mean 'icp'?"),
        ("exec:python", "expected exec:COMMAND#module:Class, where COMMAND ends with an"),
        ("exec:no-such-python#a:B", "(no-such-python): the command cannot be started"),
    ],
)
def test_what_worker_check_refuses(pytester, capsys, name, told):
    assert main(["worker-check", name]) == 1
    assert told in capsys.readouterr().err


def fnmatch_lines(text, *lines):
    pytest.LineMatcher(text.splitlines()).fnmatch_lines(lines)
