"""Perturbations do what they say and nothing else; the profile judges, records and compares."""

import numpy as np
import pytest
import tiny

from pytest_cpas.datasets.perturbed import (
    PERTURBATIONS,
    SAMPLES,
    SEVERITIES,
    Perturbed,
    RobustnessPoint,
    perturbed,
)
from pytest_cpas.evaluation import MethodRun
from pytest_cpas.golden import read_tables
from pytest_cpas.types import Camera, MethodInfo, Observation

HEIGHT, WIDTH = 120, 160
CAMERA = Camera(WIDTH, HEIGHT, 150.0, 150.0, 79.5, 59.5)


def observation():
    """A disc of radius 30 at 0.8 m before a wall at 1.2 m, with gaps."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    mask = (x - 80) ** 2 + (y - 60) ** 2 <= 30**2
    depth = np.where(mask, 0.8, 1.2).astype(np.float32)
    depth[::7, ::5] = 0
    rgb = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.float32) / 255
    return Observation(category="mug", rgb=rgb, depth=depth, mask=mask, camera=CAMERA)


def apply(name, severity):
    perturbation = PERTURBATIONS[name]
    level = perturbation.levels[severity - 1]
    return level, perturbation.apply(observation(), level, np.random.default_rng(1))


@pytest.mark.parametrize("severity", range(1, SEVERITIES + 1))
def test_depth_noise_has_the_stated_deviation(severity):
    before = observation()
    level, after = apply("depth-noise", severity)
    np.testing.assert_array_equal(after.depth == 0, before.depth == 0)
    for distance in (np.float32(0.8), np.float32(1.2)):
        error = (after.depth - before.depth)[before.depth == distance]
        assert error.std() == pytest.approx(level * distance**2, rel=0.1)
        assert abs(error.mean()) < 0.1 * level
    np.testing.assert_array_equal(after.mask, before.mask)
    np.testing.assert_array_equal(after.rgb, before.rgb)


@pytest.mark.parametrize("severity", range(1, SEVERITIES + 1))
def test_missing_depth_is_missing_in_whole_squares(severity):
    before = observation()
    level, after = apply("missing-depth", severity)
    gone = (before.depth > 0) & (after.depth == 0)
    assert gone.mean() / (before.depth > 0).mean() == pytest.approx(level, abs=0.07)
    np.testing.assert_array_equal(after.depth[~gone], before.depth[~gone])
    squares = (after.depth > 0).reshape(HEIGHT // 8, 8, WIDTH // 8, 8).any(axis=(1, 3))
    assert 1 - squares.mean() == pytest.approx(level, abs=0.07)


@pytest.mark.parametrize("severity", range(1, SEVERITIES + 1))
def test_masks_shrink_and_grow_by_pixels(severity):
    before = observation()
    level, smaller = apply("mask-erosion", severity)
    _, larger = apply("mask-dilation", severity)
    for after, radius in ((smaller, 30 - level), (larger, 30 + level)):
        assert np.sqrt(after.mask.sum() / np.pi) == pytest.approx(radius, abs=0.7)
        np.testing.assert_array_equal(after.depth, before.depth)
    assert not (smaller.mask & ~before.mask).any()
    assert not (before.mask & ~larger.mask).any()


def test_erosion_leaves_the_core_of_a_small_mask():
    before = observation()
    thin = np.zeros_like(before.mask)
    thin[50:52, 40:60] = True
    few = Observation(category="mug", rgb=before.rgb, depth=before.depth, mask=thin, camera=CAMERA)
    after = PERTURBATIONS["mask-erosion"].apply(few, 8, np.random.default_rng(0))
    assert after.mask.any()
    assert not (after.mask & ~thin).any()


@pytest.mark.parametrize("severity", range(1, SEVERITIES + 1))
def test_occlusion_hides_the_stated_share_behind_something_nearer(severity):
    before = observation()
    level, after = apply("occlusion", severity)
    assert 1 - after.mask.sum() / before.mask.sum() == pytest.approx(level, abs=0.03)
    hidden = before.mask & ~after.mask
    assert (after.depth[hidden] < 0.79).all()
    assert (after.depth[hidden] > 0).all()
    np.testing.assert_array_equal(after.depth[after.mask], before.depth[after.mask])
    np.testing.assert_array_equal(after.rgb[after.mask], before.rgb[after.mask])
    assert np.unique(after.rgb[hidden]).tolist() == [0.5]


def test_occlusion_without_any_depth():
    before = observation()
    blind = Observation(
        category="mug", rgb=before.rgb, depth=0 * before.depth, mask=before.mask, camera=CAMERA
    )
    after = PERTURBATIONS["occlusion"].apply(blind, 0.5, np.random.default_rng(0))
    assert not after.depth.any()


@pytest.mark.parametrize("severity", range(1, SEVERITIES + 1))
def test_light_leaves_the_stated_share_in_8_bits(severity):
    before = observation()
    level, after = apply("light", severity)
    assert after.rgb.mean() == pytest.approx(level * before.rgb.mean(), rel=0.01)
    counts = after.rgb.astype(float) * 255
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-4)
    np.testing.assert_array_equal(after.depth, before.depth)


@pytest.mark.parametrize("name", PERTURBATIONS)
def test_observations_are_not_modified_and_severities_share_their_draws(name):
    given = observation()
    parts = {part: getattr(given, part).copy() for part in ("rgb", "depth", "mask")}
    perturbation = PERTURBATIONS[name]
    first, again = (
        perturbation.apply(given, perturbation.levels[1], np.random.default_rng(3))
        for _ in range(2)
    )
    for part, values in parts.items():
        np.testing.assert_array_equal(getattr(given, part), values)
        np.testing.assert_array_equal(getattr(first, part), getattr(again, part))
    worst = perturbation.apply(given, perturbation.levels[2], np.random.default_rng(3))
    if name == "missing-depth":
        assert not ((first.depth == 0) & (worst.depth > 0)).any()
    if name == "occlusion":
        assert not (worst.mask & ~first.mask).any()


class Large(tiny.Tiny):
    def __init__(self):
        super().__init__(None)
        self.samples = [
            tiny.SampleRef(id=f"scene_0/{i:04d}", category="mug", scene="scene_0")
            for i in range(5 * SAMPLES)
        ]


def test_points_of_the_curves():
    needs = MethodInfo(
        name="m", categories=("mug",), needs=frozenset({"depth"}), gives=frozenset(), licence="MIT"
    )
    points = list(perturbed(Large(), needs))
    assert len(points) == 1 + 5 * SEVERITIES  # light is nothing to a depth-only method
    assert len({point.name for point in points}) == len({point.digest for point in points})
    assert {tuple(point.samples) for point in points} == {tuple(points[0].samples)}
    assert len(points[0].samples) == SAMPLES
    colour = MethodInfo(
        name="m", categories=("mug",), needs=frozenset({"rgb"}), gives=frozenset(), licence="MIT"
    )
    names = {part.point.perturbation for part in perturbed(Large(), colour)}
    assert names == {None, "mask-erosion", "mask-dilation", "occlusion", "light"}


def test_samples_of_a_perturbed_data_set():
    severe = Perturbed(Large(), PERTURBATIONS["depth-noise"], 3)
    plain = Perturbed(Large())
    first, second = severe.samples[:2]
    depth = severe.load(first).observation.depth
    np.testing.assert_array_equal(depth, severe.load(first).observation.depth)
    assert np.any(depth != plain.load(first).observation.depth)
    noise = [severe.load(ref).observation.depth - np.float32(0.8) for ref in (first, second)]
    assert np.any(noise[0] != noise[1])
    assert plain.truth(first).extents.tolist() == severe.load(first).truth.extents.tolist()


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("real275", None),
        ("ycb+real-2", None),
        ("ycb+light-4", None),
        ("synthetic-handheld", None),
        ("a+unperturbed", RobustnessPoint("a")),
        (
            "synthetic-handheld+mask-erosion-2",
            RobustnessPoint("synthetic-handheld", "mask-erosion", 2),
        ),
    ],
)
def test_names_say_what_was_perturbed(name, expected):
    assert RobustnessPoint.named(name) == expected


def test_every_point_is_known_by_its_name():
    seen = frozenset({"depth", "rgb"})
    needs = MethodInfo(name="m", categories=("mug",), needs=seen, gives=frozenset(), licence="MIT")
    parts = list(perturbed(Large(), needs))
    assert len(parts) == 1 + len(PERTURBATIONS) * SEVERITIES
    for part in parts:
        assert RobustnessPoint.named(part.name) == part.point


def test_a_data_set_is_not_taken_for_a_point_by_its_name():
    named = tiny.Tiny(None)
    named.name = "shelf+light-2"
    assert MethodRun(tiny.Perfect(), named).robustness_point is None
    point = MethodRun(tiny.Perfect(), Perturbed(named)).robustness_point
    assert point == RobustnessPoint("shelf+light-2")


PROFILE = ("--cpas-profile=robustness", "--cpas-granularity=dataset", "-q")


def curve(result):
    return [
        line.split()[:5] for line in result.outlines if line.startswith(("mask", "occl", "lig"))
    ]


def test_profile_records_and_compares_curves(cpas, pytester):
    """A method that needs its colours is as good as its light."""
    first = cpas("Perfect", *PROFILE, "--snapshot-update")
    assert first.ret == 0
    assert curve(first) == [
        ["mask-erosion", "12/12", "12/12", "12/12", "12/12"],
        ["mask-dilation", "12/12", "12/12", "12/12", "12/12"],
        ["occlusion", *curve(first)[2][1:]],
        ["light", "12/12", *curve(first)[3][2:]],
    ]
    assert all(int(cell.split("/")[0]) < 8 for cell in curve(first)[3][2:])
    (folder,) = (pytester.path / "golden/recorded/perfect").iterdir()
    assert folder.name == "tiny+robustness"
    tables = read_tables(folder).keys()
    assert len(tables) == 1 + 4 * SEVERITIES
    assert {"tiny+unperturbed", "tiny+light-3"} < tables
    again = cpas("Perfect", *PROFILE, "--cpas-require-golden", "-n2")
    assert again.ret == 0
    again.stdout.fnmatch_lines(["golden, categories of all 13 curve points: MATCHES 26"])
    worse = cpas("Biased", *PROFILE, "--cpas-require-golden")
    assert worse.ret == 1
    worse.stdout.fnmatch_lines(["*perfect on tiny+unperturbed*", "*REGRESSED mug*"])


def test_profile_is_for_complete_parts(cpas):
    result = cpas("Perfect", *PROFILE, "--cpas-limit=3", "--snapshot-update")
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*NOT RECORDED*not every sample was judged*"])


def test_method_is_loaded_once_for_all_points(cpas):
    result = cpas("CannotLoad", *PROFILE)
    assert result.ret == 1
    result.stdout.fnmatch_lines(["*truncated (try 1)*"])
    result.stdout.no_fnmatch_line("*(try 2)*")


@pytest.mark.minutes
def test_shards_of_a_profile_are_merged_and_recorded(cpas, pytester):
    for shard in ("1/2", "2/2"):
        cpas("Perfect", *PROFILE, f"--cpas-shard={shard}", "--cpas-results=out")
    files = [f"--cpas-merge={path}" for path in (pytester.path / "out").iterdir()]
    result = pytester.runpytest_inprocess("-p", "no:dash", "-q", *files, "--snapshot-update")
    result.stdout.fnmatch_lines(["golden, categories of all 13 curve points: RECORDED 13"])
    again = cpas("Perfect", *PROFILE, "--cpas-require-golden")
    assert again.ret == 0
    assert curve(result) == curve(again)
