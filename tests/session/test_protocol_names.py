"""--cpas-protocol: where protocols come from, and what is said of those that do not."""

import pytest

from pytest_cpas.protocols import Protocol, ProtocolError, shipped_protocol
from pytest_cpas.session.protocol_names import known_protocols, resolve_protocols

FILE = """
name = "mine"
[[columns]]
id = "tight"
at = { rotation_deg = 2, position_m = 0.005 }
"""

DECLARED = """
[[tool.pytest-cpas.protocols.ours.columns]]
id = "box"
at = { iou = 0.9 }
"""


@pytest.fixture
def resolve(tmp_path):
    return lambda *names: resolve_protocols(names, tmp_path, tmp_path)


@pytest.fixture
def install(tmp_path, monkeypatch):
    """A distribution whose entry point ``theirs`` is what ``source`` calls PROTOCOL."""

    def install(source: str) -> None:
        info = tmp_path / "lab-3.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: lab\nVersion: 3.1\n")
        (info / "entry_points.txt").write_text(
            "[pytest_cpas.protocols]\ntheirs = lab_protocols:PROTOCOL\n"
        )
        (tmp_path / "lab_protocols.py").write_text(source)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(__import__("sys").modules, "lab_protocols", raising=False)

    return install


def test_default_is_that_of_the_paper(resolve):
    assert resolve() == (shipped_protocol("cpas"),)


def test_each_once_and_in_order(resolve):
    names = ("omni6dpose", "cpas", "omni6dpose")
    assert [protocol.name for protocol in resolve(*names)] == ["omni6dpose", "cpas"]


def test_file_and_pyproject(resolve, tmp_path):
    (tmp_path / "mine.toml").write_text(FILE)
    (tmp_path / "pyproject.toml").write_text(DECLARED)
    assert [column.key for p in resolve("mine.toml", "ours") for column in p.columns] == [
        *("mine.tight", "ours.box")
    ]
    known = [protocol.name for protocol in known_protocols(tmp_path)]
    assert known[0] == "cpas"
    assert known[-1] == "ours"


def test_entry_point(resolve, install):
    install(
        "from pytest_cpas.protocols import *\n"
        "PROTOCOL = Protocol(name='theirs', version=1, title='t', source='', columns=("
        "CountColumn(protocol='theirs', id='a', label='IoU 0.5', limits={'iou': 0.5}),))\n"
    )
    (theirs,) = resolve("theirs")
    content = {"name": "theirs", "title": "t", "columns": [{"id": "a", "at": {"iou": 0.5}}]}
    # the same as one that was read, so that golden tables know it again
    assert theirs == Protocol.parse(content, "here")


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("PROTOCOL = 3", "protocol 'theirs': 3 is no pytest_cpas.protocols.Protocol"),
        (
            "from pytest_cpas.protocols import *\n"
            "PROTOCOL = Protocol(name='theirs', version=1, title='t', source='', columns=("
            "CountColumn(protocol='theirs', id='a', label='x', limits={'iou': 7}),))\n",
            "protocol 'theirs': column a: iou is 7, expected 0 to 1",
        ),
        (
            "from pytest_cpas.protocols import *\n"
            "PROTOCOL = Protocol(name='../x', version=1, title='t', source='', columns=())",
            "protocol 'theirs': name is '../x'",
        ),
        (
            "from pytest_cpas.protocols import *\nPROTOCOL = shipped_protocol('cpas')",
            "protocol 'theirs': name is 'cpas', expected 'theirs'",
        ),
    ],
)
def test_entry_point_that_is_no_protocol(resolve, install, source, told):
    install(source)
    with pytest.raises(ProtocolError, match=told):
        resolve("theirs")


@pytest.mark.parametrize(
    ("pyproject", "names", "told"),
    [
        ("", ("cpsa",), r"unknown protocol 'cpsa'\. Did you mean 'cpas'\? There are cpas, "),
        ("", ("zzz",), r"unknown protocol 'zzz'\. There are cpas, .*\(pytest --cpas-list\)"),
        (DECLARED, ("our",), r"Did you mean 'ours'\?"),
        ("", ("absent.toml",), "absent.toml"),
        ("", ("mine.toml", "sub/mine.toml"), "two protocols are called mine"),
        ("", ("cpas.toml",), "cpas.toml: cpas is the name of one that ships"),
        ("[tool.pytest-cpas.protocols.cpas]", ("cpas",), "it is the name of one that ships"),
        ("[tool.pytest-cpas.protocols.ours]", ("ours",), "columns is empty or missing"),
        ("[tool.pytest-cpas.protocols.ours]\nname = 'x'\n[[tool.pytest-cpas.protocols.ours."
         "columns]]\nid = 'a'\nat = {iou = 0.5}", ("ours",), "name is 'x', expected 'ours'"),
        ("[tool.pytest-cpas]\nprotocols = 3", ("cpas",), "protocols must be a table"),
        ("[tool]\npytest-cpas = 3", ("cpas",), "pytest-cpas must be a table"),
        ("tool = 3", ("cpas",), "tool must be a table"),
        ("[tool.pytest-cpas.protocols]\nours = 3", ("cpas",), "must hold tables"),
        ("tool = ", ("cpas",), "pyproject.toml: Invalid value"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(resolve, tmp_path, pyproject, names, told):
    (tmp_path / "pyproject.toml").write_text(pyproject)
    (tmp_path / "sub").mkdir()
    for name in ("mine.toml", "sub/mine.toml"):
        (tmp_path / name).write_text(FILE)
    (tmp_path / "cpas.toml").write_text(FILE.replace("mine", "cpas"))
    with pytest.raises(ProtocolError, match=told) as caught:
        resolve(*names)
    assert "\n" not in str(caught.value)


def test_run_is_judged_under_what_is_asked_for(cpas, pytester):
    (pytester.path / "mine.toml").write_text(FILE)
    assert cpas("Perfect", "--cpas-protocol=mine.toml", "--snapshot-update").ret == 0
    folder = pytester.path / "golden" / "recorded" / "perfect" / "tiny"
    assert {path.name for path in folder.iterdir()} == {"run.toml", "facts.csv", "mine.toml"}
    same = cpas("Perfect", "--cpas-protocol=mine.toml", "--cpas-require-golden")
    assert same.ret == 0
    same.stdout.fnmatch_lines(["*2 deg, 0.5 cm*", "golden: MATCHES (bowl, mug)"])
    # the default is another one: nothing is judged, and a gate says so
    assert cpas("Perfect").ret == 0
    assert cpas("Perfect", "--cpas-require-golden").ret == 1
    pytester.makeini("[pytest]\ncpas_protocol =\n    mine.toml\n")
    assert cpas("Perfect", "--cpas-require-golden").ret == 0
    assert cpas("Biased", "--cpas-require-golden").ret == 1


def test_unknown_protocol_is_a_usage_error(cpas):
    result = cpas("Perfect", "--cpas-protocol=cpsa")
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*unknown protocol 'cpsa'. Did you mean 'cpas'?*"])
    assert "Traceback" not in result.stderr.str()
