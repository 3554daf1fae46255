"""Files that name methods: what they may say, and what is said of anything else."""

from pathlib import Path

import pytest

from pytest_cpas.remote import named_methods, project_folder, spec_of
from pytest_cpas.types import ContractError, DeclarationError

WHOLE = """
[tool.pytest-cpas.methods.original]
command = ["docker", "run", "-i", "--rm", "image", "python"]
class = "wrapper:Sgpa"
path = ["third_party/sgpa", "/opt/more"]
env = { CUDA_VISIBLE_DEVICES = "0" }
paths = { "/code" = "third_party", "/weights" = "/data/weights" }
image = "sha256:0123"
worker = "/opt/worker.py"
shell = true
seconds_to_start = 300
seconds_to_load = 1.5
"""


def test_everything_that_a_table_may_say(tmp_path):
    (tmp_path / "pyproject.toml").write_text(WHOLE)
    spec = spec_of("original", tmp_path)
    assert spec.command == ("docker", "run", "-i", "--rm", "image", "python")
    assert (spec.cls, spec.name, spec.image) == ("wrapper:Sgpa", "original", "sha256:0123")
    # as the other side calls them
    assert spec.path == ("/code/sgpa", "/opt/more")
    assert spec.there(Path("/data/weights/sgpa/w.pt")) == "/weights/sgpa/w.pt"
    assert spec.there(Path("/data/other")) == "/data/other"
    assert spec.env == {"CUDA_VISIBLE_DEVICES": "0"}
    assert (spec.worker, spec.shell) == ("/opt/worker.py", True)
    assert (spec.seconds_to_start, spec.seconds_to_load) == (300.0, 1.5)


def test_a_file_without_a_project(tmp_path):
    (tmp_path / "cpas-methods.toml").write_text('[m]\ncommand = ["ssh", "h", "py"]\nclass = "a:B"')
    spec = named_methods(tmp_path)["m"]
    assert spec.shell
    assert spec.path == ()
    assert project_folder(Path("/elsewhere"), tmp_path) == tmp_path
    assert project_folder(tmp_path, Path("/elsewhere")) == tmp_path


def test_what_is_no_name_of_another_interpreter(tmp_path):
    assert spec_of("icp", tmp_path) is None
    assert spec_of("package.module:Class", tmp_path) is None


def test_a_command_of_the_command_line(tmp_path):
    spec = spec_of("exec:conda run -n 'my env' python#pkg.mod:Outer.Inner", tmp_path)
    assert spec.command == ("conda", "run", "-n", "my env", "python")
    assert (spec.cls, spec.name, spec.shell) == ("pkg.mod:Outer.Inner", "", False)
    assert spec_of("exec:/usr/bin/ssh host python#a:B", tmp_path).shell


@pytest.mark.parametrize(
    "name", ["exec:", "exec:python", "exec:#a:B", "exec:python#a", "exec:'#a:B"]
)
def test_commands_that_lead_nowhere(tmp_path, name):
    with pytest.raises(DeclarationError, match=r"method .exec:"):
        spec_of(name, tmp_path)


RIGHT = 'command = ["python"]\nclass = "a:B"\n'


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[m]\nclass = "a:B"', r"method 'm': no command; expected words that end with an interp"),
        ("[m]\ncommand = []", "no command"),
        ('[m]\ncommand = "python"', "command is 'python', expected a list of words"),
        ("[m]\ncommand = [1]", "command is .1., expected a list of words"),
        ('[m]\ncommand = ["python"]', "class is None, expected module:Class"),
        ('[m]\ncommand = ["python"]\nclass = "a"', "class is 'a', expected module:Class"),
        (f"[m]\n{RIGHT}env = 1", "env is 1, expected a table of texts"),
        (f"[m]\n{RIGHT}env.A = 1", "env is {'A': 1}, expected a table of texts"),
        (f"[m]\n{RIGHT}shell = 1", "shell is 1, expected true or false"),
        (f"[m]\n{RIGHT}seconds_to_load = 0", "seconds_to_load is 0, expected seconds above 0"),
        (f"[m]\n{RIGHT}seconds_to_load = nan", "seconds_to_load is nan, expected seconds above"),
        (f"[m]\n{RIGHT}cwd = 'x'", "has .'cwd'., expected some of command, path, class"),
        ("m = 1", "method 'm': 1, expected a table"),
        (f'["a b"]\n{RIGHT}', "method 'a b': a name becomes a folder"),
        ("[m", "cpas-methods.toml: "),
    ],
)
def test_tables_that_are_none(tmp_path, text, told):
    (tmp_path / "cpas-methods.toml").write_text(text)
    with pytest.raises(ContractError, match=told):
        named_methods(tmp_path)


@pytest.mark.parametrize("text", ["tool = 1", "[tool.pytest-cpas]\nx = 1", "[project]"])
def test_projects_that_name_no_method(tmp_path, text):
    (tmp_path / "pyproject.toml").write_text(text)
    assert named_methods(tmp_path) == {}


@pytest.mark.parametrize("text", ["[tool]\npytest-cpas = 1", "[tool.pytest-cpas]\nmethods = 1"])
def test_projects_whose_methods_are_no_tables(tmp_path, text):
    (tmp_path / "pyproject.toml").write_text(text)
    with pytest.raises(DeclarationError, match="methods is 1, expected tables"):
        named_methods(tmp_path)


def test_a_name_in_both_files(tmp_path):
    (tmp_path / "pyproject.toml").write_text(f"[tool.pytest-cpas.methods.m]\n{RIGHT}")
    (tmp_path / "cpas-methods.toml").write_text(f"[m]\n{RIGHT}")
    with pytest.raises(DeclarationError, match="it is named in pyproject"):
        named_methods(tmp_path)
