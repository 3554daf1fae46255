import sys

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


def test_two_owners_of_a_name_are_told_apart(distribution):
    distribution("lab", "[pytest_cpas.methods]\nicp = lab_icp:X\n", lab_icp="class X: pass")
    with pytest.raises(registry.RegistryError, match=r"pytest-cpas .*method_adapters.icp:Icp"):
        registry.resolve("method", "icp")


def test_unknown_name_suggests_and_lists():
    with pytest.raises(registry.RegistryError, match=r"Did you mean 'real275'\?.*synthetic-hand"):
        registry.resolve("dataset", "real257")
