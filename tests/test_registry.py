import sys
from pathlib import Path

import pytest

from pytest_cpas import registry

METADATA = "Metadata-Version: 2.1\nName: {name}\nVersion: 3.1\n"


@pytest.fixture
def distribution(tmp_path, monkeypatch):
    """Install a distribution with entry points, without a package index."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(name: str, entry_points: str, **modules: str) -> None:
        info = tmp_path / f"{name}-3.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(METADATA.format(name=name))
        (info / "entry_points.txt").write_text(entry_points)
        for module, text in modules.items():
            monkeypatch.delitem(sys.modules, module, raising=False)
            (tmp_path / f"{module}.py").write_text(text)

    return install


def test_own_entries_are_registered():
    assert {"real275", "synthetic-tabletop"} <= {e.name for e in registry.registered("dataset")}
    assert registry.resolve("method", "icp").__name__ == "Icp"


def test_class_of_the_users(distribution):
    distribution("lab", "", lab_methods="class Fine: pass")
    assert registry.resolve("method", "lab_methods:Fine").__name__ == "Fine"
    with pytest.raises(registry.RegistryError, match="lab_methods:Nope cannot be imported"):
        registry.resolve("method", "lab_methods:Nope")


def test_broken_entry_fails_only_when_asked_for_and_is_blamed(distribution):
    distribution(
        "lab", "[pytest_cpas.methods]\nbroken = lab_broken:X\n", lab_broken="import not_there"
    )
    assert "broken" in {entry.name for entry in registry.registered("method")}
    assert registry.resolve("method", "icp")
    with pytest.raises(registry.RegistryError, match=r"registered by lab 3\.1.*not_there"):
        registry.resolve("method", "broken")


def raised_by(function, *arguments):
    """What a call raises: a test that lets a skip through would be skipped."""
    try:
        function(*arguments)
    except BaseException as error:
        return error
    return None


LEAVES = {
    "exit": "import sys; sys.exit(0)",
    "SystemExit": "raise SystemExit",
    "skip": "import pytest; pytest.skip('no GPU here', allow_module_level=True)",
    "importorskip": "import pytest; pytest.importorskip('not_there')",
    "pytest.exit": "import pytest; pytest.exit('enough', returncode=0)",
}


@pytest.mark.parametrize("how", LEAVES)
def test_module_that_leaves_while_it_is_imported_is_blamed(distribution, how):
    """Whoever skips a module skips no verdict that was asked for."""
    distribution("lab", "", lab_leaves=f"{LEAVES[how]}\nclass X: pass\n")
    for kind in ("method", "dataset"):
        error = raised_by(registry.resolve, kind, "lab_leaves:X")
        assert isinstance(error, registry.RegistryError)
        assert "lab_leaves:X cannot be imported" in str(error)


def test_interrupt_while_a_module_is_imported_is_one(distribution):
    distribution("lab", "", lab_interrupted="raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        registry.resolve("method", "lab_interrupted:X")


CANNOT = {
    "TypeError": "return data_dir / 'images'",
    "AssertionError": "assert data_dir",
    "KeyError": "{}['mug']",
    **LEAVES,
}


@pytest.mark.parametrize("how", CANNOT)
@pytest.mark.parametrize("folder", [None, Path("somewhere")], ids=str)
def test_data_set_that_cannot_be_opened_is_told_with_its_folder(distribution, how, folder):
    wrong = CANNOT[how] if folder is None or "data_dir" not in CANNOT[how] else "1 / 0"
    text = f"class Data:\n    def __init__(self, data_dir):\n        {wrong}\n"
    distribution("lab", "", lab_data=text)
    words = "no folder was given with --cpas-data" if folder is None else "in somewhere"
    error = raised_by(registry.open_dataset, "lab_data:Data", folder)
    assert isinstance(error, registry.RegistryError)
    if isinstance(error.__cause__, Exception):
        expected = f"data set 'lab_data:Data' cannot be opened, {words} ("
    else:  # with the folder it has nothing to do
        kind = type(error.__cause__).__name__
        expected = f"data set 'lab_data:Data': {kind}({error.__cause__}) was raised while it"
    assert str(error).startswith(expected)


@pytest.mark.parametrize("error", ["FileNotFoundError", "ContractError"])
def test_data_set_that_says_what_is_wrong_is_heard(distribution, error):
    text = f"""
from pytest_cpas.types import ContractError

def make(data_dir):
    raise {error}("the drive is not mounted")
"""
    distribution("lab", "", lab_words=text)
    with pytest.raises(Exception, match=r"^the drive is not mounted$") as raised:
        registry.open_dataset("lab_words:make", None)
    assert raised.type.__name__ == error


def test_what_a_data_set_needs_and_lacks_is_told(distribution):
    text = "def make(data_dir):\n    raise ImportError('pip install the-drive')"
    distribution("lab", "", lab_needs=text)
    error = raised_by(registry.open_dataset, "lab_needs:make", None)
    assert isinstance(error, registry.RegistryError)
    assert str(error) == "data set 'lab_needs:make': pip install the-drive"


def test_two_owners_of_a_name_are_told_apart(distribution):
    distribution("lab", "[pytest_cpas.methods]\nicp = lab_icp:X\n", lab_icp="class X: pass")
    with pytest.raises(registry.RegistryError, match=r"pytest-cpas .*method_adapters.icp:Icp"):
        registry.resolve("method", "icp")


def test_unknown_name_suggests_and_lists():
    with pytest.raises(registry.RegistryError, match=r"Did you mean 'real275'\?.*synthetic-hand"):
        registry.resolve("dataset", "real257")
