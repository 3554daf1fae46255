"""What an item found decides, whatever a plugin or a method makes of its outcome."""

import pytest
from harness import RUN

import pytest_cpas.session.dataset_session  # noqa: F401 - runs in this process share our modules
from pytest_cpas._open3d import import_open3d

import_open3d()  # it cannot be loaded twice, and a run in this process forgets what it loaded

MODULE = """
import pytest
from tiny import *
from pytest_cpas.checks.metrics import offer

METRICS = {"chamfer": offer(lambda a, b: -1.0)}

class Raises(Perfect):
    def predict(self, batch, seed):
        raise RuntimeError("planted")

class Unreadable(Tiny):
    name = "unreadable"

    def load(self, ref):
        raise ContractError("planted")

class Skips(Perfect):
    def predict(self, batch, seed):
        pytest.skip("no GPU here")

class SkipsLoading(Perfect):
    def load(self, assets, device):
        pytest.importorskip("no_such_network")

class Fails(Perfect):
    def predict(self, batch, seed):
        pytest.xfail("the weights are not trained yet")
"""

#: What fails, by what is asked for.
ASKED = {
    "verdict": ("--cpas-method=tiny:Biased", "--cpas-dataset=tiny:Tiny"),
    "sample": ("--cpas-method=lab:Raises", "--cpas-dataset=tiny:Tiny", "-k", "test_sample"),
    "contract": ("--cpas-method=lab:Raises", "--cpas-dataset=tiny:Tiny", "-k", "test_contract"),
    "listing": ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Damaged", "-k", "test_listing"),
    "metric": ("--cpas-metrics=lab:METRICS", "--cpas-examples=1"),
    "data set": ("--cpas-check-dataset=lab:Unreadable",),
    "speed": (
        *("--cpas-method=lab:Raises", "--cpas-dataset=tiny:Tiny"),
        *("--cpas-benchmark", "-k", "test_speed"),
    ),
}

#: How a plugin hides that.
HOW = {
    "passed": """
        @pytest.hookimpl(wrapper=True, tryfirst=True)
        def pytest_runtest_logreport(report):
            report.outcome = "passed"
            return (yield)
    """,
    "xfailed": """
        @pytest.hookimpl(wrapper=True, tryfirst=True)
        def pytest_runtest_logreport(report):
            if report.failed:
                report.outcome, report.wasxfail = "skipped", "known"
            return (yield)
    """,
    "made": """
        @pytest.hookimpl(wrapper=True, tryfirst=True)
        def pytest_runtest_makereport(item, call):
            report = yield
            report.outcome = "passed"
            return report

        @pytest.hookimpl(tryfirst=True)
        def pytest_runtest_logreport(report):
            if report.nodeid.startswith("cpas"):
                report.outcome = "passed"
    """,
    "another report": """
        from copy import copy

        def good(report):
            report = pytest.TestReport(report.nodeid, report.location, {}, "passed", None,
                                       report.when)
            return report

        @pytest.hookimpl(wrapper=True, tryfirst=True)
        def pytest_runtest_makereport(item, call):
            return good((yield))

        @pytest.hookimpl(tryfirst=True)
        def pytest_runtest_logreport(report):
            report.outcome = "passed"
    """,
    "mark": """
        @pytest.hookimpl(trylast=True)
        def pytest_collection_modifyitems(items):
            for item in items:
                item.add_marker(pytest.mark.xfail(reason="known"))

        @pytest.hookimpl(tryfirst=True)
        def pytest_runtest_logreport(report):
            if report.nodeid.startswith("cpas") and report.location[1] is None:
                report.outcome = "passed"
    """,
}


@pytest.fixture
def lab(recorded, pytester):
    """Run what is asked for beside MODULE and a plugin; there is a golden table of tiny:Perfect."""
    pytester.makepyfile(lab=MODULE)
    pytester.syspathinsert()

    def run(*asked, plugin=""):
        if plugin:
            pytester.makepyfile(labs_plugin=f"import pytest\n{plugin}")
            asked = (*asked, "-p", "labs_plugin")
        start = pytester.runpytest_subprocess if "-n2" in asked else pytester.runpytest_inprocess
        return start(*RUN, *asked)

    return run


@pytest.mark.thinned(4)
@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("what", ASKED)
def test_failure_that_a_plugin_hides_is_red(lab, what, how):
    result = lab(*ASKED[what], plugin=HOW[how].replace("\n        ", "\n"))
    assert result.ret == 1, result.stdout.str()


@pytest.mark.parametrize("what", ["verdict", "sample", "contract", "metric", "data set"])
def test_failure_that_a_plugin_hides_in_workers_is_red(lab, what):
    assert lab(*ASKED[what], "-n2", plugin=HOW["made"].replace("\n        ", "\n")).ret == 1


SKIPS = """
def pytest_collection_modifyitems(items):
    for item in items:
        item.add_marker(pytest.mark.skip(reason="slow"))
"""

GOOD = {
    "sample": ("--cpas-method=tiny:Perfect", "--cpas-dataset=tiny:Tiny"),
    "metric": ("--cpas-metrics=cpas", "--cpas-examples=1", "-k", "chamfer"),
}


@pytest.mark.parametrize("what", GOOD)
def test_nobody_else_skips_an_item(lab, what):
    assert lab(*GOOD[what]).ret == 0
    result = lab(*GOOD[what], plugin=SKIPS)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*was skipped, but not by pytest-cpas: slow"])


@pytest.mark.thinned(5)
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
@pytest.mark.parametrize("method", ["Skips", "SkipsLoading", "Fails"])
@pytest.mark.parametrize("only", ["test_sample", "test_contract", "test_speed"])
def test_method_that_skips_its_own_samples_fails(lab, method, only, how):
    if only == "test_speed" and how:
        pytest.skip("nothing is timed beside workers")
    asked = ("--cpas-benchmark",) if only == "test_speed" else ()
    names = (f"--cpas-method=lab:{method}", "--cpas-dataset=tiny:Tiny", "-k", only)
    assert lab(*names, *asked, *how).ret == 1


def test_own_skips_and_known_failures_stay_what_they_are(lab, pytester):
    (pytester.path / "perfect.known.toml").write_text(
        '[[contract]]\ncheck = "repeatable"\nreason = "It draws at random."\n'
    )
    result = lab("--cpas-method=tiny:Inexact", "--cpas-dataset=tiny:Tiny", "-rsx")
    outcomes = result.parseoutcomes()
    assert outcomes["xfailed"] == 1
    assert outcomes["skipped"] >= 1
    assert "by pytest-cpas" not in result.stdout.str()


def test_second_try_counts(lab, pytester):
    """As of plugins that try again what failed."""
    pytester.makepyfile(
        second="""
        from _pytest.runner import runtestprotocol

        def pytest_runtest_protocol(item):
            reports = runtestprotocol(item, log=False)
            if any(report.failed for report in reports):
                for report in reports:
                    report.outcome = "rerun" if report.failed else report.outcome
                    item.ihook.pytest_runtest_logreport(report=report)
                item._initrequest()
                reports = runtestprotocol(item, log=False)
            for report in reports:
                item.ihook.pytest_runtest_logreport(report=report)
            return True
        """,
        flaky="""
        from tiny import *

        class Flaky(Perfect):
            failed = False

            def predict(self, batch, seed):
                if not Flaky.failed:
                    Flaky.failed = True
                    raise RuntimeError("out of memory")
                return super().predict(batch, seed)

        class Broken(Perfect):
            def predict(self, batch, seed):
                raise RuntimeError("out of memory")
        """,
    )
    for method, status in (("Flaky", 0), ("Broken", 1)):
        names = (f"--cpas-method=flaky:{method}", "--cpas-dataset=tiny:Tiny", "-k", "test_sample")
        assert lab(*names, "-p", "second").ret == status
