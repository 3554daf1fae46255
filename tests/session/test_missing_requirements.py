"""What is not installed, not there or not allowed is told in words, whatever is asked for: a run
ends with one of the exit statuses of README.md, and shows no traceback of the harness."""

import sys

import pytest
from harness import RUN

from pytest_cpas import registry

#: What is asked for; DIR is an empty folder, FILE a file that is not there.
ASKED = {
    # where all is there, what a method answers is tried elsewhere
    "icp": ["--cpas-method=icp", "--cpas-dataset=synthetic-handheld", "-k", "listing"],
    "icp, tabletop": ["--cpas-method=icp", "--cpas-dataset=synthetic-tabletop", "-k", "listing"],
    "sdfest": ["--cpas-method=sdfest", "--cpas-dataset=tiny:Tiny"],
    "spd": ["--cpas-method=spd", "--cpas-dataset=tiny:Tiny"],
    "asmnet": ["--cpas-method=asmnet", "--cpas-dataset=tiny:Tiny", "--cpas-weights=DIR"],
    "icaps": ["--cpas-method=icaps", "--cpas-dataset=tiny:Tiny", "--cpas-weights=DIR"],
    "no data": ["--cpas-method=icp", "--cpas-dataset=real275"],
    "an empty folder": ["--cpas-method=icp", "--cpas-dataset=redwood75", "--cpas-data=DIR"],
    "its own meshes": ["--cpas-method=icp", "--cpas-dataset=synthetic:DIR"],
    "check": ["--cpas-check-dataset=synthetic-handheld", "--cpas-limit=1"],
    "check, no data": ["--cpas-check-dataset=real275", "--cpas-data=DIR"],
    "robustness": [
        *("--cpas-method=tiny:Perfect", "--cpas-dataset=synthetic-tabletop"),
        *("--cpas-profile=robustness", "--cpas-limit=1"),
    ],
    "metrics": ["--cpas-metrics=open3d", "--cpas-examples=1"],
    "predictions": ["--cpas-predictions=FILE", "--cpas-dataset=real275"],
    "merge": ["--cpas-merge=FILE"],
    "benchmark": ["--cpas-benchmark", "--cpas-method=spd", "--cpas-dataset=tiny:Tiny"],
    "report": [
        *("--cpas-method=tiny:Perfect", "--cpas-dataset=synthetic-tabletop"),
        *("--cpas-limit=1", "--cpas-report=report"),
    ],
    "list": ["--cpas-list"],
}

#: What is not installed, by the names under which it is imported.
MISSING = {
    "open3d": ("open3d",),
    "torch": ("torch",),
    "pytest-benchmark": ("cpuinfo",),
    "all extras": (
        "open3d",
        "torch",
        "numba",
        "skimage",
        "yaml",
        "OpenEXR",
        "pooch",
        "requests",
        "cpuinfo",
    ),
}


@pytest.mark.parametrize("missing", MISSING)
@pytest.mark.parametrize("asked", ASKED)
def test_what_is_missing_is_told(asked, missing, cpas, pytester, tmp_path, monkeypatch):
    if "open3d" in MISSING[missing]:
        # nothing has been rendered before
        monkeypatch.setenv("CPAS_CACHE", str(tmp_path / "cache"))
    for name in MISSING[missing]:
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "folder").mkdir()
    words = [word.replace("DIR", str(tmp_path / "folder")) for word in ASKED[asked]]
    if "cpuinfo" in MISSING[missing]:
        words += ["-p", "no:benchmark"]  # whose plugin is installed here
    result = pytester.runpytest_inprocess(*RUN, *words)
    printed = result.stdout.str() + result.stderr.str()
    assert result.ret in {0, 1, 2, 4}, printed
    assert "INTERNALERROR" not in printed
    assert "Traceback" not in printed


@pytest.mark.parametrize(
    ("method", "extra"),
    [
        *((name, "torch") for name in ("spd", "crnet", "sgpa", "dpdn", "cass", "rbppose")),
        ("asmnet", "open3d,torch"),
        ("icaps", "sdf"),
        ("sdfest", "sdf"),
    ],
)
def test_what_a_method_needs_is_told_and_what_it_declares_is_listed(
    method, extra, cpas, pytester, tmp_path, monkeypatch
):
    for name in MISSING["all extras"]:
        monkeypatch.setitem(sys.modules, name, None)
    listed = pytester.runpytest_inprocess(*RUN, "-p", "no:benchmark", "--cpas-list")
    declared = [f"{' ' * 6}{word}*" for word in ("licence ", "needs ", "weights: ")]
    listed.stdout.fnmatch_lines([f"  {method} *", *declared])
    for asset in registry.resolve("method", method).info.assets:
        (tmp_path / asset.path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / asset.path).touch()
    asked = (f"--cpas-method={method}", "--cpas-dataset=tiny:Tiny", f"--cpas-weights={tmp_path}")
    result = pytester.runpytest_inprocess(*RUN, "-p", "no:benchmark", *asked)
    assert result.ret == 4
    result.stderr.fnmatch_lines([f"ERROR: *needs *pip install 'pytest-cpas[[]{extra}]'*"])
