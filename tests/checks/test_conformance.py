"""Properties, outcomes and recorded violations; faults.py holds the catalogue of faults."""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import time
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path

import faults
import numpy as np
import pytest

from pytest_cpas.checks.known import read_known
from pytest_cpas.checks.metrics import (
    KNOWN,
    PROPERTIES,
    as_subject,
    check,
    load_subject,
    offer,
    replay,
)
from pytest_cpas.checks.metrics.exact import shared_volume
from pytest_cpas.checks.metrics.recorded import known_of
from pytest_cpas.checks.metrics.subject import time_limit
from pytest_cpas.checks.outcome import Outcome
from pytest_cpas.metric_subjects.cpas import METRICS
from pytest_cpas.types import ContractError

RUN = ("-p", "no:dash", "-p", "no:cacheprovider")
CHAMFER = PROPERTIES["chamfer.by_brute_force"]
TRACES = PROPERTIES["chamfer.leaves_no_traces"]


def chamfer(change):
    right = METRICS["chamfer"].function
    return as_subject("mine", {"chamfer": offer(lambda a, b: change(right, a, b))})


def test_our_own_metrics_keep_every_property():
    subject = load_subject("pytest_cpas.metric_subjects.cpas")
    failed = {
        name: result.message
        for name, prop in PROPERTIES.items()
        if (result := check(subject, prop, examples=6)).outcome is not Outcome.PASSED
    }
    # ours are offered as integrals; test_corners.py has them with bins
    assert failed == {f"{area}.sum_over_bins": "" for area in ("iou_auc", "pose_vus")}
    assert set(subject.offers) == set(KNOWN)


@pytest.mark.parametrize("start", range(8))
def test_planted_faults_are_caught(start):
    """A part of the catalogue; ``nox -s faults`` does all of it."""
    missed = []
    for index in range(start, len(faults.FAULTS), 192):
        planted = faults.FAULTS[index]
        every = tuple(faults.properties_of(planted.metric))
        if not faults.caught_by(faults.catches(index, 0, every)):
            missed.append(f"{planted.metric}: {planted.name}")
    assert missed == []


def test_the_catalogue_is_large_and_unambiguous():
    names = [(planted.metric, planted.name) for planted in faults.FAULTS]
    assert len(set(names)) == len(names) > 60
    assert {metric for metric, _ in names} == set(KNOWN)


def test_every_property_says_what_and_why():
    for prop in PROPERTIES.values():
        assert prop.statement
        assert "\n" not in prop.statement + prop.reason
        assert prop.reason


def raises(right, a, b):
    raise RuntimeError("no such file")


def hangs(right, a, b):
    while True:
        time.sleep(0.01)


def scribbles(right, a, b):
    value = right(a, b)
    a[0] = 7
    return value


def talks(right, a, b):
    print("hello")
    return right(a, b)


def talks_through_the_descriptor(right, a, b):
    subprocess.run([sys.executable, "-c", "print('hello')"], check=True)
    return right(a, b)


def draws(right, a, b):
    np.random.rand()  # noqa: NPY002
    return right(a, b)


def draws_from_python(right, a, b):
    random.random()
    return right(a, b)


@pytest.mark.parametrize(
    ("change", "prop", "outcome"),
    [
        (raises, CHAMFER, Outcome.RAISED),
        (hangs, CHAMFER, Outcome.HUNG),
        (lambda right, a, b: None, CHAMFER, Outcome.WRONG_TYPE),
        (lambda right, a, b: "0.1", CHAMFER, Outcome.WRONG_TYPE),
        (lambda right, a, b: np.array([0.1]), CHAMFER, Outcome.WRONG_TYPE),
        (lambda right, a, b: right(a, b) * 2, CHAMFER, Outcome.VIOLATED),
        (lambda right, a, b: np.nan, CHAMFER, Outcome.VIOLATED),
        (scribbles, CHAMFER, Outcome.PASSED),
        (scribbles, TRACES, Outcome.CHANGED_ARGUMENTS),
        (talks, CHAMFER, Outcome.PASSED),
        (talks, TRACES, Outcome.PRINTED),
        (talks_through_the_descriptor, TRACES, Outcome.PRINTED),
        (draws, TRACES, Outcome.DREW_GLOBAL_RANDOM),
        (draws_from_python, TRACES, Outcome.DREW_GLOBAL_RANDOM),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)) if callable(value) else "",
)
def test_misbehaviour_is_reported_as_what_it_is(change, prop, outcome):
    limit = 0.5 if change is hangs else 30
    result = check(chamfer(change), prop, examples=8, limit=limit, shrink=False)
    assert result.outcome is outcome, result


def test_what_is_not_offered_is_not_judged():
    subject = as_subject("mine", {"chamfer": METRICS["chamfer"]})
    assert check(subject, PROPERTIES["box_iou.identity"]).outcome is Outcome.NOT_OFFERED


def test_broken_property_is_not_blamed_on_the_subject():
    from dataclasses import replace

    def body(subject, **given):
        raise KeyError("a mistake of ours")

    result = check(chamfer(lambda right, a, b: right(a, b)), replace(CHAMFER, body=body))
    assert result.outcome is Outcome.HARNESS_ERROR
    assert "a mistake of ours" in result.message


@pytest.mark.parametrize(
    ("metrics", "words"),
    [
        ({"chamfr": offer(max)}, "unknown metric 'chamfr'"),
        ({"chamfer": offer(max, angle="deg")}, "chamfer has no 'angle' to declare"),
        ({"chamfer": offer(max, combine="product")}, "combine is 'product', expected one of"),
        ({"chamfer": max}, "expected a mapping of metric names to offer"),
        (max, "expected a mapping"),
    ],
)
def test_impossible_adapter(metrics, words):
    with pytest.raises(ContractError, match=words):
        as_subject("mine", metrics)


def test_other_conventions_are_converted():
    from scipy.spatial.transform import Rotation

    def degrees(p, q):  # quaternions, scalar first
        a, b = (Rotation.from_quat(x, scalar_first=True) for x in (p, q))
        return np.rad2deg((a * b.inv()).magnitude())

    def iou(a, b):  # corners, in percent
        low, high = np.maximum(a.min(0), b.min(0)), np.minimum(a.max(0), b.max(0))
        shared = np.prod(np.maximum(high - low, 0))
        return 100 * shared / (np.prod(np.ptp(a, 0)) + np.prod(np.ptp(b, 0)) - shared)

    subject = as_subject(
        "mine",
        {
            "rotation_error": offer(degrees, rotation="quaternion-wxyz", angle="deg"),
            "box_iou": offer(iou, box=("corners",), percent=True),
        },
    )
    for name in ("rotation_error.one_axis", "rotation_error.accurate_near_zero"):
        assert check(subject, PROPERTIES[name], examples=20).outcome is Outcome.PASSED
    assert check(subject, PROPERTIES["box_iou.touching"]).outcome is Outcome.PASSED
    assert check(subject, PROPERTIES["box_iou.exact_volume"]).outcome is Outcome.VIOLATED


def test_counterexample_is_small_repeats_and_can_be_pasted(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_of_twice").mkdir()
    (tmp_path / "lab_of_twice" / "twice.py").write_text(
        "from pytest_cpas.checks.metrics import offer\n"
        "from pytest_cpas.metric_subjects.cpas import METRICS as ours\n"
        "right = ours['chamfer'].function\n"
        "METRICS = {'chamfer': offer(lambda a, b: 2 * right(a, b))}\n"
    )
    subject = load_subject("lab_of_twice.twice")
    result = check(subject, CHAMFER)
    assert result.outcome is Outcome.VIOLATED
    assert len(result.case) < 100  # one point in each cloud
    assert check(subject, CHAMFER).case == result.case
    assert replay(subject, CHAMFER, result.case).message == result.message
    lines = result.snippet.splitlines()
    call = next(line for line in lines if line.startswith("subject("))
    namespace: dict = {}
    exec("\n".join(lines[:4]) + f"\nvalue = {call}", namespace)
    assert f"gives {namespace['value']!r}" in call
    assert f"{namespace['value']!r}" in result.message


def test_exact_volume():
    def box(quaternion, centre, extents):
        return tuple(list(map(Fraction, part)) for part in (quaternion, centre, extents))

    cube = box((0, 0, 0, 1), (0, 0, 0), (1, 1, 1))
    assert shared_volume(cube, cube) == 1
    assert shared_volume(cube, box((0, 0, 0, 1), (1, 0, 0), (1, 1, 1))) == 0
    assert shared_volume(cube, box((1, 2, 3, 4), (0, 0, 0), (2, 2, 2))) == 1
    # turned about z by the angle of the 3-4-5 triangle: four corner triangles are cut off
    cut = 4 * Fraction(1, 2) * Fraction(3, 12) * Fraction(4, 12)
    assert shared_volume(cube, box((0, 0, 1, 3), (0, 0, 0), (1, 1, 1))) == 1 - cut


@pytest.fixture
def adapter(pytester, monkeypatch):
    """Run ``--cpas-metrics lab.mine`` with an adapter whose chamfer distance is ``expression``."""
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    pytester.makeini("[pytest]\nfilterwarnings = error\n")

    def run(expression, *args):
        source = f"""
            from pytest_cpas.checks.metrics import offer
            from pytest_cpas.metric_subjects.cpas import METRICS as ours
            right = ours["chamfer"].function
            METRICS = {{"chamfer": offer(lambda a, b: {expression})}}
        """
        pytester.makepyfile(**{"lab/mine": source})
        run_args = ("--cpas-metrics=lab.mine", "--cpas-examples=5", "-q", *args)
        return pytester.runpytest_subprocess(*RUN, *run_args)

    return run


def test_right_metric_passes(adapter):
    result = adapter("right(a, b)")
    assert result.ret == 0
    result.stdout.fnmatch_lines(
        ["chamfer.by_brute_force *passed", "lab.mine: * of * hold, 0 known*"]
    )


@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
def test_violations_are_reported(adapter, pytester, how):
    wrong = "2 * right(a, b)"
    result = adapter(wrong, "--cpas-metrics-report=m.json", "--cpas-metrics-report=m.md", *how)
    assert result.ret == 1
    result.stdout.fnmatch_lines(
        ["chamfer.by_brute_force: violated: the value is *, expected * within 1e-12*",
         "subject('chamfer', array(*"]
    )  # fmt: skip
    assert '"violated"' in (pytester.path / "m.json").read_text()
    assert "**lab.mine, chamfer.by_brute_force: violated.**" in (pytester.path / "m.md").read_text()


def test_violations_are_recorded_and_strict(adapter, pytester):
    wrong = "2 * right(a, b)"
    assert adapter(wrong, "--snapshot-update").ret == 0
    recorded = read_known(pytester.path / "lab" / "mine.known.toml", "metric", PROPERTIES)
    assert "chamfer.by_brute_force" in {failure.check for failure in recorded}

    for how in ((), ("--runxfail",)):
        result = adapter(wrong, *how)
        assert result.ret == 0
        result.stdout.fnmatch_lines(["chamfer.by_brute_force * violated (known)"])

    result = adapter("right(a, b)")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["chamfer.by_brute_force: recorded as violated, but it is passed*"])
    result = adapter("1 / 0")
    result.stdout.fnmatch_lines(["chamfer.by_brute_force: recorded as violated, but it is raised*"])


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (("--cpas-metrics=cpass",), "unknown metric implementation 'cpass'"),
        (("--cpas-metrics=not.there",), "cannot be imported"),
        (("--cpas-metrics=math.sin",), "cannot be imported"),
        (("--cpas-metrics=os.path",), "cannot be imported"),
    ],
)
def test_usage_errors(pytester, args, words):
    result = pytester.runpytest_subprocess(*RUN, *args)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    assert words in result.stderr.str()


PEERS = {
    "cpas_toolbox": {
        "pose_correct.spun_is_correct": (Outcome.RAISED, "rot_vec"),
        "pose_correct.shape_limits": (Outcome.VIOLATED, "nad"),
        "pose_correct.upside_down_is_wrong": (Outcome.VIOLATED, "upside down is judged correct"),
        "box_iou.touching": (Outcome.RAISED, "QhullError"),
    },
    "cutoop": {
        "box_iou.wrong_shape_rejected": (Outcome.VIOLATED, "returned 0.0"),
        "symmetric_rotation_error.zero_on_the_group": (Outcome.VIOLATED, "expected 0"),
        "average_precision.independent_of_order_under_ties": (Outcome.VIOLATED, "another order"),
    },
    "open3d": {"average_distance.nan_rejected": (Outcome.VIOLATED, "bad input")},
    "trimesh": {"box_iou.nested": (Outcome.VIOLATED, "expected")},
}


@pytest.mark.parametrize("name", PEERS)
def test_recorded_violations_of_peers(name):
    """What is known is written down; where the peer is installed, it still happens."""
    module = f"pytest_cpas.metric_subjects.{name}"
    folder = Path(__file__).parents[2] / "pytest_cpas" / "metric_subjects"
    known = read_known(folder / f"{name}.known.toml", "metric", PROPERTIES)
    recorded = {failure.check: failure for failure in known}
    for prop, (outcome, words) in PEERS[name].items():
        assert recorded[prop].outcome is outcome
        assert words in recorded[prop].reason
    needed = {"open3d": "open3d", "trimesh": "manifold3d"}.get(name, name)
    if find_spec(needed) is None:
        pytest.skip(f"{needed} is not installed; nox -s peers installs it")
    subject = load_subject(module)
    assert known_of(module) == recorded
    for prop in PEERS[name]:
        assert (
            replay(subject, PROPERTIES[prop], recorded[prop].case).outcome is recorded[prop].outcome
        )


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs timers of POSIX")
@pytest.mark.parametrize("seconds", [0.05, 30.0])
def test_timer_of_somebody_else_goes_on(seconds):
    """Another plugin's limit is not lost, also if it passes while an implementation is timed."""
    rung = []
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(1))
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds)
        with time_limit(10):
            time.sleep(0.1)
            assert not rung
        left, _ = signal.getitimer(signal.ITIMER_REAL)
        if seconds < 1:
            time.sleep(0.05)
            assert rung
        else:
            assert 25 < left <= 30
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
