"""The value of an option of ours that stands as a word of its own does not move the root directory
unseen."""

import shlex

import pytest
from harness import RUN

from pytest_cpas.session.command_line import add_options


def _valued():
    """Every option of ours that takes a value, with one that it takes."""
    from _pytest.config import get_config

    parser = get_config([])._parser
    add_options(parser)
    parser.parse_known_args([])
    optparser = getattr(parser, "optparser", None) or parser._getparser()
    for action in optparser._actions:
        (name, *_) = action.option_strings or [""]
        if name.startswith("--cpas-") and action.nargs != 0:
            yield name, "7" if action.type is int else (action.choices or ["elsewhere"])[0]


VALUED = dict(_valued())


@pytest.fixture
def project(pytester, monkeypatch):
    """A project, and beside each value of an option a folder with a configuration of its own."""
    pytester.makeini("[pytest]\ncpas_golden = tables")
    for value in {*VALUED.values(), "two words"}:
        folder = pytester.mkdir(value)
        (folder / "pytest.ini").write_text("[pytest]\n")
    pytester.makepyfile(
        test_own="""
        def test_own(pytestconfig):
            assert pytestconfig.rootpath == pytestconfig.invocation_params.dir
            assert pytestconfig.getini("cpas_golden") == "tables"
        """
    )
    return pytester


def test_the_options_are_enumerated():
    assert {"--cpas-data", "--cpas-report", "--cpas-results", "--cpas-weights"} < VALUED.keys()
    assert not {"--cpas-benchmark", "--cpas-list", "--cpas-allow-gaps"} & VALUED.keys()


@pytest.mark.parametrize("option", VALUED)
def test_moved_root_directory_is_refused(project, option):
    value = VALUED[option]
    result = project.runpytest_inprocess(*RUN, option, value)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(
        [
            f"ERROR: pytest took {value} for a test path, so its root directory is"
            f" {project.path / value} and its configuration file"
            f" {project.path / value / 'pytest.ini'}; it would be {project.path} with"
            f" {project.path / 'tox.ini'}. Write the option with the equals sign: {option}={value}"
        ]
    )


@pytest.mark.parametrize("option", ["--cpas-data", "--cpas-weights", "--cpas-golden"])
def test_what_moves_nothing_is_understood(project, tmp_path_factory, option):
    inside = project.mkdir("inside")
    outside = tmp_path_factory.mktemp("outside")
    for words in (
        [f"{option}=elsewhere"],
        [f"{option}={outside}"],
        [option, inside],
        [option, "nowhere"],
        [option, "elsewhere", "--rootdir=.", "-c", "tox.ini"],
    ):
        assert project.runpytest_inprocess(*RUN, *words, "-k", "test_own").ret == 0


def test_folder_outside_of_the_project(project, tmp_path_factory, monkeypatch):
    outside = str(tmp_path_factory.mktemp("out side"))
    result = project.runpytest_inprocess(*RUN, "--cpas-data", outside)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    form = shlex.quote(f"--cpas-data={outside}")
    result.stderr.fnmatch_lines([f"ERROR: * with the equals sign: {form}"])
    assert project.runpytest_inprocess(*RUN, f"--cpas-data={outside}").ret == 0
    # beside a test of the project pytest finds the project
    assert project.runpytest_inprocess(*RUN, "--cpas-data", outside, "test_own.py").ret == 0
    monkeypatch.setenv("PYTEST_ADDOPTS", shlex.join(["--cpas-data", outside]))
    assert project.runpytest_inprocess(*RUN).ret == pytest.ExitCode.USAGE_ERROR
    monkeypatch.setenv("PYTEST_ADDOPTS", shlex.join([f"--cpas-data={outside}"]))
    assert project.runpytest_inprocess(*RUN).ret == 0
    # a configuration file is read once the root directory is known
    monkeypatch.delenv("PYTEST_ADDOPTS")
    project.makeini(f"[pytest]\ncpas_golden = tables\naddopts = --cpas-data {outside!r}")
    assert project.runpytest_inprocess(*RUN).ret == 0


def test_arguments_from_a_file(project, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    (project.path / "words").write_text(f"--cpas-data\n{outside}\n")
    result = project.runpytest_inprocess(*RUN, "@words")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["ERROR: pytest took the value of an option for a test path, *"])


def test_golden_table_is_not_lost(recorded, tmp_path_factory):
    outside = str(tmp_path_factory.mktemp("outside"))
    for option in ("--cpas-data", "--cpas-report", "--cpas-results", "--cpas-weights"):
        assert recorded("Biased", option, outside).ret == pytest.ExitCode.USAGE_ERROR
        assert recorded("Biased", f"{option}={outside}").ret == 1
