from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pytest_cpas.metrics.average_precision import Detections
from pytest_cpas.metrics.boxes import axis_aligned_box_iou, nocs_legacy_iou
from pytest_cpas.metrics.pose import rotation_error, translation_error
from pytest_cpas.types import ContractError, Symmetry


def slow_average_precision(
    problem: list[tuple[list[float], int, dict[tuple[int, int], float]]], limit: float
) -> float:
    """One category, loops only. Per image: scores, number of truths, IoU by (prediction, truth)."""
    ranked: list[tuple[float, bool]] = []
    truths = 0
    for scores, count, iou in problem:
        truths += count
        free = set(range(count))
        for i in sorted(range(len(scores)), key=lambda i: -scores[i]):
            fitting = [j for j in free if iou[i, j] > limit]
            best = max(fitting, key=lambda j: iou[i, j], default=None)
            ranked.append((scores[i], best is not None))
            free.discard(-1 if best is None else best)
    ranked.sort(key=lambda entry: -entry[0])
    points = []
    for rank in range(1, len(ranked) + 1):
        hits = sum(correct for _, correct in ranked[:rank])
        points.append((hits / truths, hits / rank))
    area, recall = 0.0, 0.0
    for r, _ in points:
        area += (r - recall) * max(p for other, p in points if other >= r)
        recall = r
    return area


def make(images: list[tuple[int, int]], seed: int, ties: int | None = None) -> Detections:
    """Detections of one category: (predictions, truths) per image."""
    rng = np.random.default_rng(seed)
    p, g = (np.repeat(np.arange(len(images)), [image[k] for image in images]) for k in (0, 1))
    scores = rng.permutation(len(p)) if ties is None else rng.integers(0, ties, len(p))
    return Detections(p, np.ones(len(p), int), scores, g, np.ones(len(g), int), [1])


IMAGES = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), min_size=1, max_size=6)


class TestProtocol:
    @settings(deadline=None)
    @given(IMAGES, st.integers(0, 1000))
    def test_agrees_with_plain_loops(self, images: list[tuple[int, int]], seed: int) -> None:
        detections = make(images, seed)
        iou = np.random.default_rng(seed).permutation(len(detections.pairs)) / 100
        problem, first, start = [], 0, 0
        pairs = {
            (int(p), int(g)): float(v) for (p, g), v in zip(detections.pairs, iou, strict=True)
        }
        for n, m in images:
            problem.append(
                (
                    detections.scores[first : first + n].tolist(),
                    m,
                    {(i, j): pairs[first + i, start + j] for i in range(n) for j in range(m)},
                )
            )
            first, start = first + n, start + m
        got = detections.iou_ap(iou, 0.05).by_category[1]
        if start == 0:
            assert got is None
        else:
            assert got == pytest.approx(slow_average_precision(problem, 0.05), abs=1e-12)

    @settings(deadline=None)
    @given(IMAGES, st.integers(0, 1000))
    def test_order_of_the_input_does_not_matter_under_ties(
        self, images: list[tuple[int, int]], seed: int
    ) -> None:
        detections = make(images, seed, ties=3)
        rng = np.random.default_rng(seed)
        iou = rng.permutation(len(detections.pairs)) / max(50, len(detections.pairs))
        n, m = len(detections.scores), len(detections.true_category)
        image = [np.repeat(np.arange(len(images)), [i[k] for i in images]) for k in (0, 1)]
        p, g = rng.permutation(n), rng.permutation(m)
        shuffled = Detections(
            image[0][p], np.ones(n, int), detections.scores[p], image[1][g], np.ones(m, int), [1]
        )
        value = {(int(i), int(j)): v for (i, j), v in zip(detections.pairs, iou, strict=True)}
        same = np.array([value[p[i], g[j]] for i, j in shuffled.pairs])
        assert detections.iou_ap(iou, 0.1) == shuffled.iou_ap(same, 0.1)
        a = detections.pose_ap(iou, iou, 0.8, 0.8, match_iou=iou)
        assert a == shuffled.pose_ap(same, same, 0.8, 0.8, match_iou=same)

    def test_tied_scores_enter_together(self) -> None:
        """One right and one wrong at the same score: precision 1/2, whichever comes first."""
        for scores, area in (([0.5, 0.5], 0.5), ([0.6, 0.5], 1.0), ([0.5, 0.6], 0.5)):
            detections = Detections([0, 1], [1, 1], scores, [0], [1], [1])
            assert detections.iou_ap([0.9], 0.5).by_category == {1: area}

    def test_by_hand(self) -> None:
        # ranks: right, wrong, right; 4 truths: 1/4 * 1 + 1/4 * 2/3
        detections = Detections([0, 1, 2], [1] * 3, [0.9, 0.8, 0.7], [0, 1, 2, 3], [1] * 4, [1])
        assert detections.pairs.tolist() == [[0, 0], [1, 1], [2, 2]]
        result = detections.iou_ap([0.9, 0.2, 0.6], 0.5)
        assert result.by_category[1] == pytest.approx(0.25 + 0.25 * 2 / 3)

    def test_a_better_fit_may_not_take_a_truth_twice(self) -> None:
        # both predictions prefer truth 0; the second falls back on truth 1 or fails
        detections = Detections([0, 0], [1, 1], [0.9, 0.8], [0, 0], [1, 1], [1])
        assert detections.iou_ap([0.9, 0.6, 0.95, 0.55], 0.5).mean == 1
        assert detections.iou_ap([0.9, 0.6, 0.95, 0.45], 0.5).mean == 0.5

    def test_iou_is_above_and_pose_up_to_the_limit(self) -> None:
        detections = Detections([0], [1], [1.0], [0], [1], [1])
        assert detections.iou_ap([0.5], 0.5).mean == 0
        assert detections.iou_ap([np.nextafter(0.5, 1)], 0.5).mean == 1
        assert detections.pose_ap([5.0], [0.02], 5, 0.02).mean == 1
        assert detections.pose_ap([np.nextafter(5, 6)], [0.02], 5, 0.02).mean == 0
        assert detections.pose_ap([5.0], [np.nextafter(0.02, 1)], 5, 0.02).mean == 0
        assert detections.pose_ap([5.0], [0.02], 5, 0.02, match_iou=[0.1]).mean == 0
        assert detections.pose_ap([5.0], [0.02], 5, 0.02, match_iou=[0.11]).mean == 1

    def test_use_matches_for_pose_leaves_out_both_sides(self) -> None:
        # prediction 0 and truth 0 fit; prediction 1 (surer, elsewhere) and truth 1 have no match
        detections = Detections([0, 0], [1, 1], [0.5, 0.9], [0, 0], [1, 1], [1])
        iou, degrees = [0.8, 0.0, 0.0, 0.05], [1.0, 90, 90, 90]
        metres = [0.0, 9, 9, 9]
        assert detections.pose_ap(degrees, metres, 5, 0.05).mean == 0.25
        assert detections.pose_ap(degrees, metres, 5, 0.05, match_iou=iou).mean == 1

    def test_what_is_left_out_cannot_be_taken(self) -> None:
        # the surer prediction has no match at IoU 0.1, so its good pose takes no truth away
        detections = Detections([0, 0], [1, 1], [0.9, 0.5], [0], [1], [1])
        assert detections.pose_ap([1, 2], [0, 0], 5, 0.05, match_iou=[0.05, 0.8]).mean == 1
        # the prediction's match is far off; the truth beside it has a good pose but no match
        detections = Detections([0], [1], [0.9], [0, 0], [1, 1], [1])
        assert detections.pose_ap([90, 2], [0, 0], 5, 0.05, match_iou=[0.8, 0.05]).mean == 0

    def test_pose_matching_minimises_degrees_plus_centimetres(self) -> None:
        # the surer prediction takes truth 1 (3 + 1) rather than truth 0 (1 + 4): both match
        detections = Detections([0, 0], [1, 1], [0.9, 0.8], [0, 0], [1, 1], [1])
        args = [1.0, 3.0, 1.0, 90.0], [0.04, 0.01, 0.0, 0.0]
        assert detections.pose_ap(*args, 5, 0.05).mean == 1
        args = [1.0, 3.0, 1.0, 90.0], [0.01, 0.04, 0.0, 0.0]
        assert detections.pose_ap(*args, 5, 0.05).mean == 0.5

    def test_categories_without_truth_or_predictions(self) -> None:
        detections = Detections([0, 0], [1, 3], [0.9, 0.9], [0, 0], [1, 2], [1, 2, 3])
        result = detections.iou_ap([0.9], 0.5)
        assert result.by_category == {1: 1.0, 2: 0.0, 3: None}
        assert result.mean == 0.5
        pose = detections.pose_ap([1.0], [0.0], 5, 0.05, match_iou=[0.9])
        assert pose.by_category == {1: 1.0, 2: 0.0, 3: None}
        assert Detections([], [], [], [], [], [1]).iou_ap([], 0.5).mean is None

    def test_images_and_categories_do_not_mix(self) -> None:
        for order in permutations(range(4)):
            image, category = (
                np.array([0, 0, 1, 1])[list(order)],
                np.array([1, 2, 1, 2])[list(order)],
            )
            detections = Detections(image, category, np.ones(4), [0, 0, 1, 1], [1, 2, 1, 2], [1, 2])
            assert sorted(detections.pairs.tolist()) == sorted([i, o] for i, o in enumerate(order))

    def test_refusals(self) -> None:
        with pytest.raises(ContractError, match="scores: 1 of 1 values are NaN"):
            Detections([0], [1], [np.nan], [0], [1], [1])
        with pytest.raises(ContractError, match="of the predictions"):
            Detections([0, 1], [1], [0.5], [0], [1], [1])
        detections = Detections([0], [1], [0.5], [0], [1], [1])
        with pytest.raises(ContractError, match=r"expected \(1,\)"):
            detections.iou_ap([0.5, 0.5], 0.5)
        with pytest.raises(ContractError, match="1 of 1 values are NaN"):
            detections.pose_ap([np.nan], [0.0], 5, 0.05)


@pytest.fixture(scope="module")
def real(test_data: Path) -> tuple[Detections, dict[str, np.ndarray]]:
    with np.load(test_data / "predictions" / "dualposenet_real275.npz") as stored:
        data = {name: stored[name] for name in stored.files}
    image = {
        side: np.repeat(np.arange(len(data["frame"])), np.diff(data[f"{side}_offset"]))
        for side in ("pred", "gt")
    }
    detections = Detections(
        image["pred"],
        data["pred_class_ids"],
        data["pred_scores"],
        image["gt"],
        data["gt_class_ids"],
        range(1, 7),
    )
    p, g = detections.pairs.T
    boxes = []
    for side, rows in (("pred", p), ("gt", g)):
        linear = data[f"{side}_RTs"][rows, :3, :3]
        scale = np.cbrt(np.linalg.det(linear))[:, None]
        boxes += [linear / scale[..., None], data[f"{side}_RTs"][rows, :3, 3]]
        boxes += [data[f"{side}_scales"][rows] * scale]
    category, handle = data["gt_class_ids"][g], data["gt_handle_visibility"][g]
    round_about_y = np.isin(category, (1, 2, 4)) | ((category == 6) & (handle == 0))
    values = {
        "degrees": np.empty(len(p)),
        "metres": translation_error(boxes[1], boxes[4]),
        "legacy": np.empty(len(p)),
        "axis-aligned": np.empty(len(p)),
    }
    for chosen, symmetry, spins in (
        (round_about_y, Symmetry.about((0, 1, 0)), 20),
        (~round_about_y, Symmetry.none(), 1),
    ):
        part = [box[chosen] for box in boxes]
        values["degrees"][chosen] = np.degrees(rotation_error(part[0], part[3], symmetry))
        values["legacy"][chosen] = nocs_legacy_iou(*part, spins=spins)
        values["axis-aligned"][chosen] = axis_aligned_box_iou(*part, spins=spins)
    return detections, values


class TestPublishedFigures:
    """The figures that DualPoseNet's paper prints for REAL275, from its own predictions."""

    @pytest.mark.parametrize(
        ("iou", "limit", "printed"),
        [
            ("legacy", 0.5, 79.8),
            ("legacy", 0.75, 62.2),
            ("axis-aligned", 0.5, 74.4),
            ("axis-aligned", 0.75, 30.8),
        ],
    )
    def test_iou(
        self,
        real: tuple[Detections, dict[str, np.ndarray]],
        iou: str,
        limit: float,
        printed: float,
    ) -> None:
        detections, values = real
        mean = detections.iou_ap(values[iou], limit).mean
        assert mean is not None
        assert round(100 * mean, 1) == printed

    @pytest.mark.parametrize(
        ("degrees", "metres", "printed"),
        [(5, 0.02, 29.3), (5, 0.05, 35.9), (10, 0.02, 50.0), (10, 0.05, 66.8)],
    )
    def test_pose(
        self,
        real: tuple[Detections, dict[str, np.ndarray]],
        degrees: float,
        metres: float,
        printed: float,
    ) -> None:
        detections, values = real
        args = values["degrees"], values["metres"], degrees, metres
        mean = detections.pose_ap(*args, match_iou=values["legacy"]).mean
        assert mean is not None
        assert round(100 * mean, 1) == printed
        everything = detections.pose_ap(*args).mean
        assert everything is not None
        assert everything < mean
