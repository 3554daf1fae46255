"""What docs/recipes.md and the tutorials tell people to type, run as it stands there."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from docs_pages import blocks, section_of, text

yaml = pytest.importorskip("yaml")

PAGE = text("recipes.md")
TINY = {"METHOD": "tiny:Perfect", "DATASET": "tiny:Tiny", "DEVICE": "cpu"}


def workflow(title):
    (body,) = blocks(section_of(PAGE, title), "yaml")
    return yaml.safe_load(body)


@pytest.fixture
def project(recorded, pytester):
    """A project with a golden table, in which a warning is an error."""
    pytester.makeini("[pytest]\nfilterwarnings = error\n")
    return pytester.path


@pytest.fixture
def checkout(project, tmp_path_factory):
    """Another machine that has the project."""

    def checkout():
        folder = tmp_path_factory.mktemp("machine")
        shutil.copytree(project, folder, dirs_exist_ok=True)
        return folder

    return checkout


def run(command, folder, **env):
    """Run lines of a recipe there; the exit code and what was printed."""
    assert "${{" not in command
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    addopts = "-p no:dash -p no:cacheprovider"
    result = subprocess.run(
        ["bash", "-e", "-c", command],
        cwd=folder,
        env={**os.environ, "PATH": path, "PYTEST_ADDOPTS": addopts, **TINY, **env},
        capture_output=True,
        text=True,
    )
    return result.returncode, result.stdout + result.stderr


def steps(job):
    """The commands of a GitHub job by the names of its steps."""
    return {step["name"]: step["run"] for step in job["steps"] if "name" in step}


def test_github_on_one_machine(project):
    job = workflow("GitHub Actions: one machine")["jobs"]["verdict"]
    assert set(job["env"]) == {*TINY, "CPAS_CACHE"}
    code, printed = run(steps(job)["Judge"], project)
    assert code == 0, printed
    assert run(steps(job)["Show"], project, GITHUB_STEP_SUMMARY="summary.md")[0] == 0
    told = (project / "summary.md").read_text()
    assert told.startswith("# pytest-cpas: PASSED\n")
    assert "MATCHES" in told
    for path in job["steps"][-1]["with"]["path"].split():
        assert (project / path).exists()


@pytest.mark.parametrize(("method", "lost"), [("Biased", 0), ("Perfect", 2)])
def test_github_shards(checkout, method, lost):
    """One method regressed; of the other one, a machine died."""
    whole = workflow("GitHub Actions: shards and merge")
    assert set(whole["env"]) == set(TINY)
    shard, merge = whole["jobs"]["shard"], whole["jobs"]["merge"]
    merging = checkout()
    given = {"METHOD": f"tiny:{method}"}
    upload = next(s["with"] for s in shard["steps"] if "upload" in s.get("uses", ""))
    download = next(s["with"] for s in merge["steps"] if "download" in s.get("uses", ""))
    assert download["merge-multiple"]
    count = len(shard["strategy"]["matrix"]["shard"])
    for index in {*shard["strategy"]["matrix"]["shard"]} - {lost}:
        here = checkout()
        command = steps(shard)["Judge"].replace("${{ matrix.shard }}", str(index))
        code, printed = run(command, here, **given)
        assert code == (method == "Biased"), printed
        shutil.copytree(here / upload["path"], merging / download["path"], dirs_exist_ok=True)
    code, printed = run(steps(merge)["Judge"], merging, **given)
    if lost:
        assert code == 4
        assert f"shard {lost}/{count} is missing" in printed
        return
    assert code == 1, printed
    assert run(steps(merge)["Show"], merging, GITHUB_STEP_SUMMARY="summary.md")[0] == 0
    told = (merging / "summary.md").read_text()
    assert told.startswith("# pytest-cpas: FAILED\n")
    assert "REGRESSED" in told
    assert (merging / "report" / "report.html").is_file()


def test_gitlab(checkout, project):
    jobs = workflow("GitLab")
    assert {*TINY} < set(jobs["variables"])
    shard, merge = jobs["shard"], jobs["merge"]
    assert shard["parallel"] > 1
    for index in ("1", "2"):
        here = checkout()
        (command,) = shard["script"]
        place = {"CI_NODE_INDEX": index, "CI_NODE_TOTAL": "2"}
        code, printed = run(command, here, **place)
        assert code == 0, printed
        for path in shard["artifacts"]["paths"]:
            shutil.copytree(here / path, project / path, dirs_exist_ok=True)
    (command,) = merge["script"]
    code, printed = run(command, project)
    assert code == 0, printed
    assert "golden: MATCHES" in printed
    for path in (*merge["artifacts"]["paths"], merge["artifacts"]["reports"]["junit"]):
        assert (project / path).exists()


def test_slurm(project):
    shard, merge = blocks(section_of(PAGE, "Slurm"), "bash")
    assert "\n#SBATCH --array=1-" in shard
    for index in ("1", "2", "2"):  # the last one as if it was killed late, and queued again
        place = {"SLURM_ARRAY_TASK_ID": index, "SLURM_ARRAY_TASK_COUNT": "2"}
        code, printed = run(shard, project, **place)
        assert code == 0, printed
    code, printed = run(merge, project)
    assert code == 0, printed
    assert (project / "report" / "report.md").is_file()


def test_the_metric_authors_tutorial(pytester):
    """Its code violates what it says, and less once it is mended as it says."""
    tutorial = text("metric-author.md")
    first, adapter, mended, boxes, alone = blocks(tutorial, "python")
    (pytester.mkdir("lab") / "adapter.py").write_text(adapter)
    shown = re.findall(r"^(\S+\.\w+) +(violated|passed)$", tutorial, re.MULTILINE)

    def outcomes(content):
        (pytester.path / "lab" / "metrics.py").write_text(content)
        chosen = " or ".join(sorted({name for name, _ in shown}))
        code, printed = run(f'pytest --cpas-metrics lab.adapter -q -k "{chosen}"', pytester.path)
        assert code == 1
        return dict(re.findall(r"^(\S+\.\w+) +(violated|passed)$", printed, re.MULTILINE))

    before, after = shown[:6], shown[6:]
    found = outcomes(first)
    assert {name: found[name] for name, _ in before} == dict(before)
    found = outcomes(mended)
    assert {name for name, word in found.items() if word == "violated"} == {n for n, _ in after}
    compile(alone, "tutorial", "exec")

    (pytester.path / "lab" / "boxes.py").write_text(
        "from pytest_cpas.metrics import oriented_iou\n\n\n"
        "def iou(r_a, t_a, half_a, r_b, t_b, half_b):\n"
        "    return oriented_iou(r_a, t_a, 2 * half_a, r_b, t_b, 2 * half_b)\n"
    )
    (pytester.path / "lab" / "adapter.py").write_text(boxes)
    code, printed = run('pytest --cpas-metrics lab.adapter -q -k "box_iou.nested"', pytester.path)
    assert (code, "box_iou.nested_either_way  passed" in printed) == (0, True), printed
