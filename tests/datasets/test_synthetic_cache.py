"""The embedded data sets are made once, in a cache that the code which makes them names."""

import ast
import hashlib
import pickle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pytest_cpas.datasets import synthetic
from pytest_cpas.datasets.synthetic import HANDHELD, Split, generate


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> type[synthetic.SyntheticHandheld]:
    """The handheld class with one scene of one frame, and an empty cache of its own."""
    monkeypatch.setenv("CPAS_CACHE", str(tmp_path / "cache"))
    split = Split("small", 1, HANDHELD.camera, 1, 1, HANDHELD.kind)
    return type("Small", (synthetic.SyntheticHandheld,), {"split": split})


def test_it_is_made_once(small: type[synthetic.SyntheticHandheld], tmp_path: Path) -> None:
    first = small(None)
    assert [ref.category for ref in first.samples] == ["bottle"]
    assert first.root.parent == tmp_path / "cache"
    before = {p: p.stat().st_mtime_ns for p in first.root.rglob("*")}
    again = small(tmp_path / "elsewhere")  # --cpas-data is for data sets that are published
    assert (again.root, again.digest) == (first.root, first.digest)
    assert before == {p: p.stat().st_mtime_ns for p in again.root.rglob("*")}
    assert [p.name for p in first.root.parent.iterdir()] == [first.root.name]


def test_digest_is_of_the_decoded_content(small: type[synthetic.SyntheticHandheld]) -> None:
    tree = small(None)
    digest = hashlib.sha256()
    stem = tree.root / "real_test/scene_1"
    for kind in ("color", "depth", "mask", "coord"):
        digest.update(np.asarray(Image.open(stem / f"0000_{kind}.png")).tobytes())
    digest.update((stem / "0000_meta.txt").read_bytes())
    truth = tree.root / "gts/real_test/results_real_test_scene_1_0000.pkl"
    digest.update(pickle.loads(truth.read_bytes())["gt_RTs"].tobytes())
    digest.update((tree.root / "fixed_real_test_obj_models/bottle_0.obj").read_bytes())
    digest.update((tree.root / "obj_models/real_test/bottle_0.txt").read_bytes())
    assert tree.digest == digest.hexdigest()


def test_a_failure_leaves_nothing_behind(
    small: type[synthetic.SyntheticHandheld], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(synthetic._Writer, "finish", fail)
    with pytest.raises(KeyboardInterrupt):
        small(None)
    assert list((tmp_path / "cache").iterdir()) == []


def test_a_faster_process_wins(
    small: type[synthetic.SyntheticHandheld], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def overtaken(split: Split, root: Path) -> None:
        generate(split, root)
        monkeypatch.setattr(synthetic, "generate", generate)
        small(None)
        marker = next(p for p in root.parent.iterdir() if not p.name.startswith("."))
        (marker / "first").touch()

    monkeypatch.setattr(synthetic, "generate", overtaken)
    tree = small(None)
    assert (tree.root / "first").is_file()
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [tree.root.name]


def test_a_cache_that_cannot_be_written_is_named(
    small: type[synthetic.SyntheticHandheld], tmp_path: Path
) -> None:
    (tmp_path / "cache").write_text("a file, not a folder")
    with pytest.raises(RuntimeError, match=r"small is made on first use.*Set CPAS_CACHE"):
        small(None)


def test_another_recipe_gets_another_folder(
    small: type[synthetic.SyntheticHandheld], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    roots = {small(None).root}
    for module in synthetic.MAKERS:
        changed = tmp_path / "changed.py"
        changed.write_bytes(Path(str(module.__file__)).read_bytes() + b"\n")
        with monkeypatch.context() as patch:
            patch.setattr(module, "__file__", str(changed))
            roots.add(small(None).root)
    assert len(roots) == 1 + len(synthetic.MAKERS)


def test_the_recipe_has_every_module_that_decides_the_content() -> None:
    """Those of the data sets' room that the makers import, and not the readers of trees."""
    known = {module.__name__ for module in synthetic.MAKERS}
    for module in synthetic.MAKERS:
        source = Path(str(module.__file__)).read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and str(node.module) == "pytest_cpas.datasets":
                assert {f"{node.module}.{alias.name}" for alias in node.names} <= known
            elif isinstance(node, ast.ImportFrom) and "pytest_cpas.datasets." in str(node.module):
                assert node.module in known
