"""What a gate is about: the categories that were asked for, all of them and no others."""

import pytest
from harness import RUN, unfolded

GATE = ("--cpas-require-golden",)


@pytest.mark.thinned(5)
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
@pytest.mark.parametrize(
    "asked", [("--cpas-category=mug",), ("-k", "mug"), ("-k", "test_sample and mug")], ids=" ".join
)
def test_one_category_is_gated_alone(recorded, asked, how):
    good = recorded("Perfect", *GATE, *asked, *how)
    assert good.ret == 0
    good.stdout.fnmatch_lines(
        ["6 of 12 samples judged", "rows: computed 6, not asked for bowl", "golden: MATCHES mug*"]
    )
    worse = recorded("Biased", *GATE, *asked, *how)
    assert worse.ret == 1
    worse.stdout.fnmatch_lines(["golden: REGRESSED mug*"])
    # the method's mistake is about mugs alone
    other = [arg.replace("mug", "bowl") for arg in asked]
    assert recorded("Biased", *GATE, *other, *how).ret == 0


@pytest.mark.thinned(5)
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
@pytest.mark.parametrize(
    "asked",
    [
        ("-k", "0003 or 0004"),
        ("-k", "bowl or 0009"),
        ("--cpas-limit=6",),
        ("--cpas-limit=1",),
        ("--cpas-shard=1/2",),
        ("-k", "test_contract"),
        ("--cpas-category=mug", "-k", "test_contract or test_listing"),
        ("--cpas-category=mug", "--cpas-limit=5"),
    ],
    ids=" ".join,
)
def test_part_of_a_category_is_no_gate(recorded, asked, how):
    result = recorded("Perfect", *GATE, *asked, *how)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["golden: NOT CHECKED*"])


def test_categories_that_a_worker_lost_are_asked_for(recorded):
    """What a crash leaves unjudged was selected."""
    result = recorded("Dies", "-n2", *GATE)
    assert result.ret == 1


def test_category_of_the_golden_table_that_is_gone_is_asked_for(recorded):
    assert recorded("OnlyMugs", *GATE).ret == 1
    assert recorded("OnlyMugs", *GATE, "--cpas-category=mug").ret == 0


def test_by_scene_as_by_sample(recorded):
    assert recorded("Perfect", *GATE, "--cpas-granularity=scene", "-k", "scene_1").ret == 1
    assert recorded("Perfect", *GATE, "--cpas-granularity=scene", "--cpas-category=mug").ret == 0


def test_one_table_that_is_not_recorded_does_not_stop_the_next(cpas, pytester):
    pytester.makepyfile(
        second="""
        from tiny import *

        class Second(Perfect):
            info = replace(Perfect.info, name="second")
        """
    )
    assert cpas("Perfect", "--snapshot-update", "--cpas-jitter=2").ret == 0
    names = ("--cpas-method=second:Second", "--snapshot-update")
    result = cpas("Perfect", *names)
    assert result.ret == 1
    unfolded(result).fnmatch_lines(
        ["golden: NOT RECORDED: *pass --cpas-jitter 2*", "golden: RECORDED: *second*"]
    )


def test_known_violation_that_is_gone_is_red_after_a_merge(cpas, pytester):
    file = pytester.path / "perfect.known.toml"
    file.write_text('[[contract]]\ncheck = "repeatable"\nreason = "It draws at random."\n')
    assert cpas("Perfect").ret == 1
    for index in (1, 2):
        assert cpas("Perfect", f"--cpas-shard={index}/2", "--cpas-results=out").ret == 0
    paths = sorted((pytester.path / "out").iterdir())
    merged = pytester.runpytest_inprocess(*RUN, *(f"--cpas-merge={path}" for path in paths))
    assert merged.ret == 1
    merged.stdout.fnmatch_lines(["*repeatable is a known violation of perfect, but it holds; *"])
    part = pytester.runpytest_inprocess(*RUN, f"--cpas-merge={paths[0]}", "--cpas-allow-gaps")
    assert part.ret == 0


def test_images_that_a_method_writes_into_are_its_own(cpas, pytester):
    """Both objects of a frame, and both seeds, see the image as it is."""
    pytester.makepyfile(
        writing="""
        from tiny import *

        class Shared(Tiny):
            name = "shared"

            def load(self, ref):
                if not hasattr(self, "image"):
                    self.image = super().load(ref).observation
                sample = super().load(ref)
                observation = replace(sample.observation, depth=self.image.depth,
                                      rgb=self.image.rgb, mask=self.image.mask)
                return replace(sample, observation=observation)

        class Writes(Perfect):
            info = replace(Perfect.info, name="writes")

            def predict(self, batch, seed):
                for observation in batch:
                    if not observation.mask.any() or not observation.depth.any():
                        raise RuntimeError("somebody has written into this")
                    answers = super().predict([observation], seed)
                    observation.depth[:] = 0
                    observation.mask[:] = False
                return answers
        """
    )
    result = pytester.runpytest_inprocess(
        *RUN, "--cpas-method=writing:Writes", "--cpas-dataset=writing:Shared", "--cpas-jitter=2",
        "-k", "test_sample",
    )  # fmt: skip
    output = result.stdout.str()
    assert "somebody has written" not in output
    assert "12 of 12 samples judged" in output


@pytest.mark.thinned(5)
@pytest.mark.parametrize("how", [(), ("-n2",)], ids=" ".join)
@pytest.mark.parametrize("name", ["Gefäß", "tasse ☕", "a\\b", "a[b]", "a::b", "mug-can", "é é"])
def test_category_of_any_name_is_asked_for(cpas, pytester, name, how):
    """pytest writes node ids its own way; a category that is lost is red whatever it is called."""
    pytester.makepyfile(
        named=f"""
        from tiny import *

        NAME = {name!r}

        def renamed(ref):
            return replace(ref, category=NAME if ref.category == "mug" else ref.category)

        class Named(Tiny):
            name = "named"

            def __init__(self, data_dir=None):
                super().__init__(data_dir)
                self.samples = [renamed(ref) for ref in self.samples]

            def load(self, ref):
                real = "mug" if ref.category == NAME else ref.category
                sample = super().load(replace(ref, category=real))
                seen = replace(sample.observation, category=ref.category)
                return replace(sample, ref=ref, observation=seen)

        class Good(Perfect):
            info = replace(Perfect.info, categories=("bowl", NAME))

        class Loses(Good):
            def predict(self, batch, seed):
                if batch and batch[0].category == NAME:
                    return [Prediction.failed("lost") for _ in batch]
                return super().predict(batch, seed)
        """
    )
    cpas("Perfect", "--collect-only")  # has tiny copied
    names = ("--cpas-dataset=named:Named", *GATE)
    good = ("--cpas-method=named:Good", *names)
    assert pytester.runpytest_subprocess(*RUN, *good, "--snapshot-update").ret == 0
    assert pytester.runpytest_subprocess(*RUN, *good, *how).ret == 0
    lost = pytester.runpytest_subprocess(*RUN, "--cpas-method=named:Loses", *names, *how)
    assert lost.ret == 1
    assert f"REGRESSED {name}" in lost.stdout.str()


@pytest.mark.parametrize("selection", [("--cpas-limit=1",), ("-k", "test_contract")], ids=" ".join)
def test_jitter_without_a_judged_sample_of_a_category(cpas, selection):
    assert cpas("Wobbles", "--snapshot-update", "--cpas-jitter=5").ret == 0
    result = cpas("Wobbles", *selection)
    assert result.ret in (0, 1)
    assert "INTERNALERROR" not in result.stdout.str() + result.stderr.str()
    result.stdout.fnmatch_lines(["golden: NOT CHECKED*"])


@pytest.mark.parametrize("demands", [True, False])
def test_recording_says_that_it_demands_nothing(cpas, demands):
    result = cpas("Perfect", "--snapshot-update", *["--cpas-require-golden"] * demands)
    assert result.ret == 0
    told = "--snapshot-update has recorded, and nothing was judged: --cpas-require-golden"
    assert (told in result.stdout.str()) == demands


@pytest.mark.parametrize("asked", [("mgu", "mug"), ("MUG", "mug"), ("mug", "")])
@pytest.mark.parametrize("how", ["--cpas-require-golden", "--snapshot-update"])
def test_a_category_that_nothing_is_of_is_refused_beside_one_that_is(recorded, asked, how):
    result = recorded("Perfect", *[f"--cpas-category={name}" for name in asked], how)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    (wrong,) = {*asked} - {"mug"}
    told = f"--cpas-category {wrong}: no sample is of that category; *are of bowl, mug"
    result.stderr.fnmatch_lines([f"*{told}*"])
