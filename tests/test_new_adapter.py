"""A new user makes an adapter and goes where its sentences lead."""

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
