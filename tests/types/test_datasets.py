"""What data sets have without saying so, what wrappers pass on, and what is no data set."""

import inspect
import sys

import numpy as np
import pytest
import tiny
from docs_pages import blocks, section_of, text
from tiny import Tiny

import pytest_cpas.datasets.categories  # which has a wrapper, and so has this:
import pytest_cpas.session.known_faults  # noqa: F401
from pytest_cpas import registry
from pytest_cpas.checks.dataset.facts import survey
from pytest_cpas.datasets._tree import Tree
from pytest_cpas.datasets.perturbed import Perturbed
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.types import Camera, DataError, Dataset, SampleRef, WrappedDataset, as_dataset

FIELDS = ("name", "samples", "digest", "missing", "damaged")

MEMBERS = sorted(
    name for name in {*vars(Dataset), *Dataset.__annotations__} if not name.startswith("_")
)


def test_defaults():
    data = Tiny(None)
    assert (data.absent, data.camera, data.quick_truth) == (frozenset(), None, False)
    first = data.samples[0]
    assert data.truth(first).extents.tolist() == data.load(first).truth.extents.tolist()


def test_a_truth_of_its_own_is_quick_unless_that_is_denied():
    class Quick(Tiny):
        def truth(self, ref):
            return tiny.truth(0)

    class Fitted(Quick):
        quick_truth = False

    class FittedToo(Fitted):
        def truth(self, ref):
            return tiny.truth(1)

    kinds = (Tiny, Quick, Fitted, FittedToo, Tree)
    quick = [kind.__new__(kind).quick_truth for kind in kinds[:-1]]
    assert quick == [False, True, False, False]
    assert Tree.truth is not Dataset.truth


def test_load_is_what_a_data_set_cannot_go_without(monkeypatch):
    class Half(Dataset):
        pass

    monkeypatch.setattr(tiny, "Half", Half, raising=False)
    with pytest.raises(registry.RegistryError, match=r"'tiny:Half': the class Half has no load$"):
        registry.open_dataset("tiny:Half", None)


class Reference:
    id, category, scene = "a", "mug", "s"


class Unsaid:
    """Like a data set that raises when it is asked."""

    name, digest, missing, damaged = "unsaid", "0", (), ()

    def __init__(self, data_dir):
        pass

    @property
    def samples(self):
        raise RuntimeError("no disk")

    def load(self, ref):
        raise NotImplementedError


@pytest.mark.parametrize(
    ("part", "value", "words"),
    [
        ("name", 5, "name is 5, expected a text"),
        ("digest", b"00", "digest is b'00', expected a text"),
        ("samples", None, "samples is None, expected a sequence of SampleRef"),
        ("samples", [Reference()], "samples has .*Reference object.*, expected SampleRef"),
        ("missing", "all of it", "missing is 'all of it', expected a sequence of texts"),
        ("damaged", [ValueError("x")], r"damaged has ValueError\('x'\), expected texts"),
        ("damaged", {"a": 1}, "damaged is {'a': 1}, expected a sequence of texts"),
    ],
)
def test_part_that_is_not_of_its_kind_is_told(part, value, words):
    data = Tiny(None)
    setattr(data, part, value)
    with pytest.raises(DataError, match=f"data set 'Tiny': {words}"):
        as_dataset(data)


def test_data_set_that_raises_when_it_is_asked(monkeypatch):
    monkeypatch.setattr(tiny, "Unsaid", Unsaid, raising=False)
    with pytest.raises(registry.RegistryError, match=r"tiny:Unsaid.*\(RuntimeError: no disk\)"):
        registry.open_dataset("tiny:Unsaid", None)


# -- wrappers -----------------------------------------------------------------------------------


class Marks:
    """Gives a mark for every member, so that what is passed on is known again."""

    def __init__(self) -> None:
        for name in MEMBERS:
            if inspect.isfunction(vars(Dataset).get(name)):
                setattr(self, name, lambda *given, name=name: (name, *given))
            else:
                setattr(self, name, f"the {name} of another")


@pytest.mark.parametrize("name", MEMBERS)
def test_wrappers_pass_on_every_member(name):
    """A member that is added to Dataset, and not to WrappedDataset, fails here."""
    marks = Marks()
    wrapped = WrappedDataset(marks)
    found, expected = getattr(wrapped, name), getattr(marks, name)
    if callable(expected):
        assert found("ref") == expected("ref") == (name, "ref")
    else:
        assert found == expected


def wrappers(kind=WrappedDataset):
    for one in kind.__subclasses__():
        yield from (one, *wrappers(one))


def test_what_wrappers_change():
    """What a wrapper of ours gives that is not the other's is what it is there for."""
    own = {
        kind.__name__: {name for name in MEMBERS if name in vars(kind)}
        for kind in wrappers()
        if kind.__module__.startswith("pytest_cpas.")
    }
    assert own == {
        "CategorisedDataset": {"truth", "load", "image_of", "fit_error", "unseen", "box_of"},
        "DetectedDataset": {"load", "unseen", "notes"},
        "Perturbed": {"load"},
        "_Adapted": {"truth", "image_of", "fit_error", "unseen", "box_of", "notes"},
        "_WithoutFaults": {"load", "truth"},
    }
    whole = Held(None)
    part = Perturbed(whole)
    changed = {n for n in MEMBERS if n not in own["Perturbed"] and getattr(part, n) is not None}
    changed = {n for n in changed if not callable(getattr(part, n))}
    changed = {n for n in changed if getattr(part, n) != getattr(whole, n)}
    assert changed == {"name", "digest", "samples"}


class Held(Tiny):
    """A data set that has something else than a default everywhere."""

    camera = Camera(8, 6, 11.0, 10.0, 3.5, 2.5)
    published_axes = ((0, 1, 0), (1, 0, 0), (0, 0, 1))
    published_centres = {"mug": (0, 0, 1)}  # noqa: RUF012
    quick_truth = False
    missing = ("a frame",)
    damaged = ("a line",)

    def __init__(self, data_dir) -> None:
        super().__init__(data_dir)
        self.absent = {self.samples[0].id}

    def truth(self, ref):
        return tiny.truth(5)


def test_a_perturbed_data_set_has_the_camera_and_the_pace_of_the_other():
    part = Perturbed(Held(None))
    assert (part.camera, part.quick_truth) == (Held.camera, False)
    assert not Perturbed(Tiny(None)).quick_truth
    run = MethodRun(tiny.Perfect(), part)
    assert (run.focal, run.quick_truth) == (11.0, False)


# -- data sets that do not inherit ----------------------------------------------------------------


class Duck:
    """As documented before there was something to inherit from."""

    name, digest, missing, damaged = "duck", "duck-1", ("a frame",), ("a line",)

    def __init__(self, data_dir=None) -> None:
        self._tiny = Tiny(data_dir)
        self.samples = self._tiny.samples

    def load(self, ref):
        return self._tiny.load(ref)


class Swan(Duck):
    """... with what was asked for by name alone."""

    camera = Camera(8, 6, 11.0, 10.0, 3.5, 2.5)
    absent = frozenset({"scene_0/0001"})

    def truth(self, ref):
        return tiny.truth(5)


def adapted(kind, **parts):
    made = type(kind.__name__, (kind,), {"__module__": kind.__module__, **parts})()
    with pytest.warns(DeprecationWarning, match=rf"{kind.__name__}, a data set that does not"):
        return made, as_dataset(made)


def test_a_data_set_without_a_base_is_adapted_with_a_warning():
    made, data = adapted(Duck)
    assert isinstance(data, Dataset)
    for field in FIELDS:
        assert getattr(data, field) is getattr(made, field)
    assert (data.absent, data.camera, data.quick_truth) == (frozenset(), None, False)
    second = data.samples[1]
    assert data.load(second).ref == second
    assert data.truth(second).extents.tolist() == tiny.EXTENTS.tolist()
    # beside it is where a list of known failures is looked for
    assert inspect.getfile(type(data)) == __file__
    assert as_dataset(data) is data


def test_what_it_has_beyond_that_is_kept():
    _, data = adapted(Swan)
    assert (data.absent, data.camera, data.quick_truth) == (Swan.absent, Swan.camera, True)
    wanted = tiny.truth(5).pose.rotation.tolist()
    assert data.truth(data.samples[0]).pose.rotation.tolist() == wanted
    _, fitted = adapted(Swan, quick_truth=False)
    assert not fitted.quick_truth


def test_those_who_take_data_sets_take_it_too():
    with pytest.warns(DeprecationWarning, match="Duck, a data set"):
        run = MethodRun(tiny.Perfect(), Duck())
    assert (run.dataset, run.damaged) == ("duck", ("a line",))
    with pytest.warns(DeprecationWarning, match="Swan, a data set"):
        points = survey(Swan(), [])
    assert points.name == "duck"


@pytest.mark.parametrize("option", ["--cpas-dataset", "--cpas-check-dataset"])
def test_a_run_tells_it(cpas, pytester, option):
    pytester.makepyfile(
        duck="from tiny import Tiny\n\nclass Duck:\n"
        "    def __init__(self, folder):\n"
        "        vars(self).update(vars(Tiny(folder)))\n"
        "        self.name, self.digest = 'duck', 'duck-1'\n"
        "        self.missing = self.damaged = ()\n\n"
        "    def load(self, ref):\n"
        "        return Tiny(None).load(ref)\n"
    )
    method = ["--cpas-method=tiny:Perfect"] if option == "--cpas-dataset" else []
    result = pytester.runpytest_subprocess("-p", "no:dash", "-q", *method, f"{option}=duck:Duck")
    assert "tiny" not in result.stderr.str()
    told = [line for line in (*result.errlines, *result.outlines) if "Deprecation" in line]
    assert len(told) == 1
    assert (
        "duck.Duck, a data set that does not inherit from pytest_cpas.Dataset, is deprecated"
        in told[0]
    )
    assert "duck" in result.stdout.str()
    assert result.ret in (0, 1)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (None, r"made as builtins\.NoneType, which has no name, samples, digest, .*load;"),
        (Duck, r"the class itself .*\.Duck, which has no samples; .* inherits from"),
        (
            type("Goose", (Tiny,), {"__init__": lambda self, data_dir: None})(None),
            r"made as .*\.Goose, which has no samples;",
        ),
    ],
)
def test_what_is_no_data_set_is_told_what_it_lacks(made, words, monkeypatch):
    monkeypatch.setattr(tiny, "make", lambda data_dir: made, raising=False)
    with pytest.raises(DataError, match="'tiny:make': " + words):
        registry.open_dataset("tiny:make", None)


def test_a_name_that_stands_for_something_else_is_refused(monkeypatch):
    monkeypatch.setattr(Held, "name", "stored")
    with pytest.raises(DataError, match="'Held' has the name 'stored', which stands for the"):
        MethodRun(tiny.Perfect(), Held(None))


@pytest.mark.parametrize("category", ["all", "completeness"])
def test_a_category_by_which_tables_mean_something_else_is_refused(category):
    with pytest.raises(DataError, match=f"sample a: category '{category}', by which tables"):
        SampleRef(id="a", category=category, scene="s")


def test_what_cannot_be_called_makes_no_data_set(cpas):
    result = cpas("Perfect", dataset="CAMERA")
    assert result.ret == 4
    result.stderr.fnmatch_lines(["*data set 'tiny:CAMERA': Camera Camera(*cannot be called*"])


def test_the_example_of_the_documentation_is_one(tmp_path, monkeypatch):
    (body,) = blocks(section_of(text("datasets.md"), "A data set in code"), "python")
    (tmp_path / "lab_shelf.py").write_text(body)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lab_shelf", raising=False)
    np.savez(
        tmp_path / "shelf.npz",
        rgb=np.full((2, 480, 640, 3), 0.5, np.float32),
        depth=np.ones((2, 480, 640), np.float32),
        mask=np.ones((2, 480, 640), bool),
        rotation=np.stack([np.eye(3)] * 2),
        translation=np.array([[0, 0, 1.0], [0, 0, 1.5]]),
        extents=np.full((2, 3), 0.2),
    )
    data = registry.open_dataset("lab_shelf:Shelf", tmp_path)
    assert [ref.id for ref in data.samples] == ["0000", "0001"]
    assert data.quick_truth
    assert data.load(data.samples[1]).truth.pose.translation.tolist() == [0, 0, 1.5]
