"""The code of a data set counts: what changes a sample is another program."""

import functools
import importlib
import sys

import pytest
import tiny

from pytest_cpas import registry
from pytest_cpas.datasets.perturbed import Perturbed
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.evaluation.program import UNKNOWN, found_programs, program_of, take_programs

#: What is asked for as lab_data:made, by how it is made.
MADE = {
    "class": "class made(tiny.Tiny): pass",
    "class beside it": "from lab_deep import Data as made",
    "no Dataset": """
class made:
    def __init__(self, data_dir):
        data = tiny.Tiny(data_dir)
        self.name, self.samples, self.digest = data.name, data.samples, data.digest
        self.missing = self.damaged = ()
        self.load = data.load
""",
    "namespace": """
def made(data_dir):
    data = tiny.Tiny(data_dir)
    parts = ("name", "samples", "digest", "missing", "damaged", "load")
    return types.SimpleNamespace(**{part: getattr(data, part) for part in parts})
""",
    "function": "def made(data_dir): return tiny.Tiny(data_dir)",
    "wrapper": """
class Wrapper(WrappedDataset):
    def __init__(self, data_dir):
        super().__init__(tiny.Tiny(data_dir))
made = Wrapper
""",
    "wrapper by a function": "def made(data_dir): return WrappedDataset(tiny.Tiny(data_dir))",
    "wrapped": """
class Deep(tiny.Tiny): pass

def made(data_dir): return WrappedDataset(WrappedDataset(Deep(data_dir)))
""",
}


@pytest.fixture
def code(tmp_path, monkeypatch):
    """The digest of the data set ``lab_data:made`` with a comment."""
    monkeypatch.syspath_prepend(tmp_path)

    def code_with(text, comment, wrap=lambda data: data):
        for name in ("lab_data", "lab_deep"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        head = "import tiny, types\nfrom pytest_cpas.types import WrappedDataset\n"
        (tmp_path / "lab_data.py").write_text(head + text)
        (tmp_path / "lab_deep.py").write_text(f"{head}class Data(tiny.Tiny): {comment!r}")
        if "lab_deep" not in text:
            with (tmp_path / "lab_data.py").open("a") as file:
                file.write(f"\n# {comment}\n")
        importlib.invalidate_caches()
        data = registry.open_dataset("lab_data:made", None)
        return MethodRun(tiny.Perfect(), wrap(data)).provenance["data_code"]

    return code_with


@pytest.mark.filterwarnings("ignore:.*a data set that does not inherit:DeprecationWarning")
@pytest.mark.parametrize("how", MADE)
def test_code_of_a_data_set_counts(code, how):
    one, other = (code(MADE[how], comment) for comment in ("one", "other"))
    assert UNKNOWN not in (one, other)
    assert one != other


def test_code_of_perturbed_data_counts(code):
    seen = [code(MADE["function"], comment, Perturbed) for comment in ("one", "one", "other")]
    assert UNKNOWN not in seen
    assert seen[0] == seen[1]
    assert seen[0] != seen[2]


@pytest.mark.filterwarnings("ignore:.*a data set that does not inherit:DeprecationWarning")
@pytest.mark.parametrize(
    "text",
    [
        "made = functools.partial(tiny.Tiny)",
        "class Maker:\n  def __call__(self, data_dir): return tiny.Tiny(data_dir)\nmade = Maker()",
        "exec('class made(tiny.Tiny): __module__ = \"nowhere\"')",
    ],
)
def test_code_that_cannot_be_seen_is_unknown(code, text):
    assert code(f"import functools\n{text}", "one") == UNKNOWN


def test_folder_of_its_own_is_read_by_the_same_code(tmp_path, monkeypatch):
    """NAME:DIR is the data set that NAME is, in another place."""

    class Entry:
        name, value, module, attr, dist = "own", "tiny:make", "tiny", "make", None

    monkeypatch.setattr(tiny, "make", lambda data_dir: tiny.Tiny(data_dir), raising=False)
    monkeypatch.setattr(registry, "registered", lambda kind: [Entry])
    codes = {
        MethodRun(tiny.Perfect(), registry.open_dataset(name, None)).provenance["data_code"]
        for name in ("own", f"own:{tmp_path}")
    }
    assert len(codes) == 1
    assert UNKNOWN not in codes


def test_programs_are_handed_over(monkeypatch):
    """A worker has what the controller found, and looks for nothing itself."""
    from pytest_cpas.evaluation import program

    monkeypatch.setattr(program, "_handed", {})
    program_of.cache_clear()
    found = program_of(tiny.Perfect)
    handed = found_programs()
    program_of.cache_clear()
    monkeypatch.setattr(program, "_look_for", functools.partial(pytest.fail, "looked for"))
    take_programs(handed)
    assert program_of(tiny.Perfect) == found
    program_of.cache_clear()
