"""What installing the plugin does to people who do not use it, and what it ships."""

import importlib.metadata
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

HEAVY = ("numpy", "scipy", "torch", "open3d", "trimesh", "PIL")
ROOT = Path(__file__).parents[1]


def run_python(code: str, folder: Path, **env: str) -> str:
    """What ``code`` prints, in a folder without a conftest.py."""
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        check=True,
        capture_output=True,
        text=True,
        env=os.environ | env,
    ).stdout


PROBE = f"""
import sys, pytest
class Probe:
    def pytest_sessionfinish(self, session):
        print("HEAVY:", sorted(set({HEAVY}) & set(sys.modules)))
code = pytest.main([{{args}}], plugins=[Probe()])
"""


@pytest.mark.parametrize("autoload", ["", "1"])
def test_plugin_start_imports_nothing_heavy(tmp_path, autoload):
    """Alone, and with all plugins that our own dependencies bring."""
    (tmp_path / "test_x.py").write_text("def test_x(): pass")
    args = f"'-p', 'no:cacheprovider', '--rootdir', {str(tmp_path)!r}, {str(tmp_path)!r}"
    args += ", '-p', 'pytest_cpas.plugin'" if autoload else ", '-p', 'no:dash'"
    out = run_python(PROBE.format(args=args), tmp_path, PYTEST_DISABLE_PLUGIN_AUTOLOAD=autoload)
    assert "1 passed" in out
    assert "HEAVY: []" in out


def test_list_says_what_methods_need_and_whether_weights_are_there(tmp_path):
    """Methods are imported for it, so they must be light until they are loaded."""
    heavy = tuple(name for name in HEAVY if name not in ("numpy", "scipy"))
    info = tmp_path / "lab-3.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 3.1\n")
    (info / "entry_points.txt").write_text(
        "[pytest_cpas.methods]\nbroken = lab_broken:X\nempty = collections:Counter\n"
    )
    (tmp_path / "lab_broken.py").write_text("import not_there")
    (tmp_path / "weights").mkdir()
    (tmp_path / "weights" / "mean_points_emb.npy").touch()
    code = (
        "import sys, pytest; code = pytest.main(['--cpas-list', '-p', 'no:dash', *sys.argv[1:]]); "
        f"print('HEAVY:', sorted(set({heavy}) & set(sys.modules)), code)"
    )
    path = {"PYTHONPATH": str(tmp_path)}
    out = run_python(code, tmp_path, **path, CPAS_WEIGHTS=str(tmp_path / "weights"))
    assert "HEAVY: [] 0" in out
    lines = [line.strip() for line in out.splitlines()]

    def after(*words: str) -> list[str]:
        (start,) = (i for i, line in enumerate(lines) if tuple(line.split()[:2]) == words)
        return lines[start + 1 : start + 5]

    licence, parts, weights, _ = after("icp", "method_adapters.icp:Icp")
    assert (licence, parts) == ("licence MIT", "needs depth; gives pose, extents, shape")
    assert weights == "weights: none needed"
    licence, parts, weights, _ = after("sgpa", "method_adapters.sgpa:Sgpa")
    assert licence == "licence MIT (this port; the weights state no licence)"
    assert parts == "needs depth, rgb; gives pose, extents, shape"
    assert weights == f"weights: 1 of 2 found in {tmp_path}/weights, missing sgpa/real.pth"
    _, _, weights, _ = after("asmnet", "method_adapters.asmnet:AsmNet")
    assert weights.startswith(
        f"weights: 0 of 12 found in {tmp_path}/weights, missing asmnet/params"
    )
    assert weights.endswith(" and 9 more")
    (reason, *_) = after("broken", "lab_broken:X")
    assert reason.startswith("cannot be used: method 'broken', registered by lab 3.1: lab_broken:X")
    assert "No module named 'not_there'" in reason
    (reason, *_) = after("empty", "collections:Counter")
    assert reason == "cannot be used: it has no attribute info of type MethodInfo"
    after("real275", "pytest_cpas.datasets.nocs:Real275")

    out = run_python(code, tmp_path, CPAS_WEIGHTS="")
    assert "weights: sgpa/real.pth, mean_points_emb.npy (no --cpas-weights to look in)" in out


def test_metrics_import_without_pytest_and_heavy_extras(tmp_path):
    forbidden = ("pytest", "torch", "open3d", "trimesh")
    code = f"import sys, pytest_cpas.metrics; print(sorted(set({forbidden}) & set(sys.modules)))"
    assert run_python(code, tmp_path).strip() == "[]"


def test_runs_of_methods_do_not_import_the_search_for_counterexamples(tmp_path):
    code = "import sys, pytest_cpas.session.method_session; print('hypothesis' in sys.modules)"
    assert run_python(code, tmp_path).strip() == "False"


def test_wheel_holds_everything(tmp_path):
    """Type marker, assets, suite, golden tables; no tests and no benchmark."""
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {
        "pytest_cpas/py.typed",
        "pytest_cpas/suite/test_samples.py",
        "pytest_cpas/adapter_template/method.py.template",
        "pytest_cpas/datasets/sources.toml",
        "pytest_cpas/report/schema.json",
        "pytest_cpas/report/page/page.css",
        "pytest_cpas/report/page/page.js",
        "pytest_cpas/datasets/real275.known.toml",
        "pytest_cpas/protocols/shipped/cpas.toml",
        "pytest_cpas/protocols/shipped/omni6dpose.toml",
        "method_adapters/py.typed",
        "method_adapters/icp_priors.npz",
    } <= names
    tables = [path for path in (ROOT / "golden").rglob("*.*") if path.is_file()]
    shipped = {f"pytest_cpas/shipped_golden/{path.relative_to(ROOT / 'golden')}" for path in tables}
    assert {path.parent.name for path in tables} >= {"synthetic-tabletop", "synthetic-handheld"}
    assert shipped <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "golden/"))]


def test_version_is_the_distributions():
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert f"## {importlib.metadata.version('pytest-cpas')}" in changelog
