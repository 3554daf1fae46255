"""Every task of the project, each in an environment of its own: ``nox -s demo``, ``nox -l``."""

import os
import shutil
import sys
from pathlib import Path

import nox

nox.options.sessions = ["lint", "types", "tests"]
nox.options.reuse_existing_virtualenvs = True
nox.options.error_on_missing_interpreters = True

# BLAS threads beside xdist workers only get in each other's way
ENV = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

#: The same for a process that keeps what it compiles, whatever is usual on this machine.
KEEPS = {**ENV, "PYTHONDONTWRITEBYTECODE": ""}

#: All extras.
EVERYTHING = "benchmark,exr,fast,fetch,open3d,sdf,torch,xdist"


def install(session: nox.Session, *requirements: str) -> None:
    session.install("--constraint", "constraints.txt", *requirements)


@nox.session
def demo(session: nox.Session) -> None:
    """Run the classical baseline on the embedded data set and show its tables."""
    install(session, "-e", ".[open3d,xdist]")
    session.run(
        "pytest",
        "--cpas-method=icp",
        "--cpas-dataset=synthetic-tabletop",
        "--cpas-dataset=synthetic-handheld",
        "--cpas-require-golden",
        "--numprocesses=2",
        "--quiet",
        *session.posargs,
        env=ENV,
    )


@nox.session
def tests(session: nox.Session) -> None:
    """The project's own tests, but those that take minutes, which ``ports`` and ``stress`` run."""
    install(session, "-e", f".[{EVERYTHING}]", "--group", "test")
    quick = ("-m", "not minutes")
    # imports every module: else each of the processes that tests start might compile them anew
    session.run("pytest", "-qq", "tests/test_public_names.py", env=KEEPS)
    session.run("pytest", "--numprocesses=2", *quick, *session.posargs, env=ENV)


@nox.session
def lint(session: nox.Session) -> None:
    """Style and common mistakes."""
    install(session, "--group", "lint")
    session.run("ruff", "check", ".")
    session.run("ruff", "format", "--check", ".")


@nox.session
def types(session: nox.Session) -> None:
    """Static types, strict."""
    install(session, "-e", f".[{EVERYTHING}]", "--group", "types")
    session.run("mypy")


@nox.session
def benchmarks(session: nox.Session) -> None:
    """Ratios against peers, measured in the same run."""
    install(session, "-e", ".[benchmark,fast,open3d,sdf,torch]")
    session.install("--no-deps", "cpas_toolbox==1.0.0", "absl-py")
    for script in session.posargs or sorted(str(p) for p in Path("benchmarks").glob("bench_*.py")):
        session.run("python", script, env=ENV)


#: Those with seeded random weights that give likely answers.
PORTS = ("spd", "crnet", "sgpa", "dpdn", "cass", "asmnet", "rbppose", "sdfest")


@nox.session
def ports(session: nox.Session) -> None:
    """The ports with seeded random weights: golden tables, contract, the networks of a peer."""
    install(session, "-e", ".[open3d,sdf,torch,xdist]")
    session.install("--no-deps", "cpas_toolbox==1.0.0", "absl-py", "opencv-python-headless<5")
    weights = session.create_tmp()
    session.run("python", "tests/ports/plausible.py", weights, env=ENV)
    for names, dataset in ((PORTS, "synthetic-handheld"), (("sgpa",), "synthetic-tabletop")):
        session.run(
            "pytest",
            *(f"--cpas-method={name}" for name in names),
            f"--cpas-dataset={dataset}",
            f"--cpas-weights={weights}",
            "--cpas-golden=tests/ports/golden",
            "--cpas-require-golden",
            "--numprocesses=2",
            "--quiet",
            env=ENV,
        )
    # about ten minutes: some 15 seconds per answer, of which the contract takes 30
    session.run("python", "tests/ports/icaps_cases.py", "weights", weights, env=ENV)
    session.run(
        "pytest",
        "--cpas-method=icaps",
        "--cpas-dataset=icaps_cases:Few",
        f"--cpas-weights={weights}",
        "--cpas-golden=tests/ports/golden",
        "--cpas-require-golden",
        "--quiet",
        env=ENV | {"PYTHONPATH": "tests/ports"},
    )
    session.run("pytest", "tests/ports", env=ENV)


@nox.session
def gpu(session: nox.Session) -> None:
    """The ports on a GPU: parity with the CPU, contract, times beside goals, in some minutes.
    ``-- --python PYTHON`` takes the interpreter of an environment that has torch already."""
    script, arguments = "tests/ports/gpu.py", list(session.posargs)
    if arguments[:1] == ["--python"]:
        session.run(arguments[1], script, *arguments[2:], external=True)
        return
    # not of constraints.txt, which asks for the torch without CUDA
    session.install("-e", ".[open3d,sdf,torch]", "pytest")
    session.run("python", script, *arguments)


#: Interpreters, and a numpy of their time.
INTERPRETERS = {"python3.6": "numpy==1.13.3", "python3.8": "numpy==1.24.4", "pypy3": "numpy<2"}


@nox.session
def interpreters(session: nox.Session) -> None:
    """The worker in interpreters of long ago, each with numpy: those that are named, or on the path
    (``nox -s interpreters -- /opt/python3.6/bin/python3.6``)."""
    install(session, "-e", ".", "--group", "test")
    session.install("vermin==1.9.2")
    worker = "pytest_cpas/remote/worker.py"
    session.run("vermin", "-t=3.6-", "--eval-annotations", "--violations", "--no-tips", worker)
    made = []
    for path in session.posargs or filter(shutil.which, INTERPRETERS):
        folder = Path(session.create_tmp()) / Path(path).name
        session.run(path, "-m", "venv", "--clear", str(folder), external=True)
        made.append(str(folder / "bin" / "python"))
        numpy = INTERPRETERS.get(Path(path).name, "numpy")
        session.run(made[-1], "-m", "pip", "install", "-q", numpy, external=True)
    env = {"CPAS_TEST_INTERPRETERS": os.pathsep.join(made)}
    session.run("pytest", "tests/remote/test_interpreters.py", env=ENV | env)


@nox.session
def docs(session: nox.Session) -> None:
    """The documentation, in site/, with the report of a run that is made for it."""
    # every method is imported to be asked for what it declares
    install(session, "-e", ".[benchmark,open3d,sdf,torch]", "--group", "docs")
    session.run(
        "pytest",
        "--cpas-method=icp",
        "--cpas-dataset=synthetic-handheld",
        "--cpas-limit=36",
        "--cpas-report=docs/example",
        "--quiet",
        env=ENV,
    )
    # mkdocs makes an HTML page of each Markdown file, under the same name
    example = Path("docs/example")
    (example / "report.md").replace(example / "summary.md")
    quiet = {"NO_MKDOCS_2_WARNING": "1"}
    session.run("mkdocs", "build", "--strict", *session.posargs, env=quiet)


@nox.session
def docs_figures(session: nox.Session) -> None:
    """Draw the pictures of the documentation anew; ``-- DATA`` also those of real data."""
    install(session, "-e", ".[open3d]", "--group", "docs")
    for name in ("sample_count_convergence", "pictures"):
        session.run("python", f"docs/figures/{name}.py", env=os.environ | ENV)
    if session.posargs:
        session.run("python", "docs/figures/up_axes.py", *session.posargs, env=ENV)


@nox.session
def browser(session: nox.Session) -> None:
    """A report and the site of ``docs`` in Chromium, which must be installed; ``-- -k looks``."""
    install(session, "-e", ".", "--group", "test")
    pages = ("tests/report/browser_report.py", "tests/documentation/browser_site.py")
    session.run("pytest", *pages, *session.posargs, env=os.environ | ENV)


@nox.session
def faults(session: nox.Session) -> None:
    """Plant every fault of the catalogues, in metrics and in a method; every check catches one."""
    install(session, "-e", ".", "--group", "test")
    session.run("python", "tests/checks/faults.py", *session.posargs, env=ENV)
    session.run("python", "tests/checks/method_faults.py", *session.posargs, env=ENV)


@nox.session
def budget(session: nox.Session) -> None:
    """How sure is each planted fault in a metric to be caught: of what is drawn, with 300 seeds."""
    install(session, "-e", ".", "--group", "test")
    session.run("python", "tests/checks/budget.py", *session.posargs, env=ENV)


@nox.session
def mutants(session: nox.Session) -> None:
    """Mutants of our own metrics as implementations under test; survivors are explained."""
    install(session, "-e", ".", "--group", "test")
    session.run("python", "tests/checks/mutants.py", *session.posargs, env=ENV)


@nox.session
def peers(session: nox.Session) -> None:
    """Check published implementations of metrics: their recorded violations still happen."""
    install(session, "-e", ".[open3d,xdist]", "manifold3d", "opencv-python-headless", "tqdm")
    # what else these two require is not needed for their metrics
    session.install("--no-deps", "cpas_toolbox==1.0.0", "cutoop==0.1.0")
    names = session.posargs or ["cpas", "cpas_toolbox", "cutoop", "open3d", "trimesh"]
    session.run("pytest", *(f"--cpas-metrics={name}" for name in names), env=ENV)
    session.run("pytest", "tests/checks", "-k", "recorded_violations_of_peers", env=ENV)


@nox.session
def stress(session: nox.Session) -> None:
    """Kill runs and writers at 200 random moments, and golden updates at every step: the old table
    or the new one is there, and each run is resumed and ends with the same table. Then the tests
    of whole runs that ``tests`` leaves out."""
    install(session, "-e", f".[{EVERYTHING}]", "--group", "test")
    session.run("python", "tests/session/stress_kills.py", *session.posargs, env=ENV)
    enumerated = ("tests/golden/test_golden_kills.py", "tests/evaluation/test_results_file.py")
    session.run("pytest", *enumerated, env=ENV)
    long = ("-m", "minutes", "--ignore=tests/ports", "--numprocesses=2")
    session.run("pytest", *long, "tests", env=ENV)


@nox.session
def stress_timing(session: nox.Session) -> None:
    """Find a planted slow-down of 30 %, and none where there is none, on a busy machine."""
    install(session, "-e", ".[benchmark]")
    session.run("python", "tests/timing/stress_timing.py", *session.posargs, env=ENV)


@nox.session
def fuzz(session: nox.Session) -> None:
    """Damage every format that is read, 20000 times by seeded mutations, then a minute for each
    reader guided by coverage; ``-- COUNT [SEED]`` for others of the first kind alone."""
    install(session, "-e", f".[{EVERYTHING}]", "--group", "test")
    session.run("python", "tests/reading/fuzzing.py", *(session.posargs or ["20000"]), env=ENV)
    session.run("pytest", "tests/reading/test_pickle_fuzz.py", env=ENV | {"CPAS_FUZZ": "20000"})
    if not session.posargs and session.python is None and sys.version_info < (3, 14):
        session.install("atheris>=3")  # wheels for Linux and Python 3.11 to 3.13
        session.run("python", "tests/reading/fuzzing.py", "--atheris", "60", env=ENV)
