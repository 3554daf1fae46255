from pathlib import Path

import cases
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from method_adapters._crop import (
    Crop,
    NoAnswerError,
    back_project,
    crop_of,
    depth_pixels,
    feature_index,
    network_image,
    resize,
    subset_in_order,
)
from method_adapters._depth_filling import fill_depth
from method_adapters._networks.heads import assigned
from method_adapters._prior_method import MUG_OFFSET, Inputs, pose_from_coordinates
from method_adapters.dpdn import Dpdn
from pytest_cpas.similarity import NoSimilarityError, robust_umeyama, umeyama
from pytest_cpas.types import Camera


def box_mask(y1, x1, y2, x2, shape=(480, 640)):
    mask = np.zeros(shape, bool)
    mask[y1, x1 : x2 + 1] = mask[y2, x2] = True
    return mask


@pytest.mark.parametrize(
    ("box", "crop"),
    [
        ((100, 200, 139, 230), (99, 195, 40)),  # 39 rows between first and last: 40
        ((100, 200, 140, 230), (80, 175, 80)),  # 40 is not above 40
        ((100, 201, 139, 232), (99, 196, 40)),  # halves are cut: (201 + 232) // 2 = 216
        ((0, 0, 10, 30), (0, 0, 40)),
        ((0, 300, 100, 320), (0, 250, 120)),
        ((470, 630, 479, 639), (440, 600, 40)),
        ((0, 0, 479, 639), (19, 99, 440)),
        ((0, 639, 479, 639), (19, 200, 440)),
        ((240, 320, 240, 320), (220, 300, 40)),
    ],
)
def test_crop_rule(box, crop):
    assert crop_of(box_mask(*box)) == Crop(*crop, crop[2])


def test_crop_stays_in_small_images():
    assert crop_of(box_mask(0, 0, 90, 120, (95, 130))) == Crop(5, 20, 80, 80)
    with pytest.raises(NoAnswerError, match="the image is 30 pixels"):
        crop_of(box_mask(0, 0, 90, 20, (95, 30)))


@pytest.mark.parametrize("side", [40, 120, 192, 440])
def test_resize_as_torch(side):
    image = np.random.default_rng(side).random((side, side, 3), dtype=np.float32)
    expected = torch.nn.functional.interpolate(
        torch.from_numpy(image).double().permute(2, 0, 1)[None], (192, 192), mode="bilinear"
    )
    ours = resize(image, 192)
    np.testing.assert_allclose(ours, expected[0].permute(1, 2, 0), atol=1e-6)


@pytest.mark.parametrize("side", [40, 120, 192, 440])
def test_resize_as_opencv(side):
    cv2 = pytest.importorskip("cv2")
    image = np.random.default_rng(side).random((side, side, 3), dtype=np.float32)
    expected = cv2.resize(image, (192, 192), interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(resize(image, 192), expected, atol=1e-6)


def test_image_is_normalised_channels_first():
    rgb = np.zeros((480, 640, 3), np.float32)
    rgb[:, :, 0], rgb[:, :, 2] = 0.485, 1.0
    image = network_image(rgb, Crop(0, 0, 40, 40))
    assert image.shape == (3, 192, 192)
    np.testing.assert_allclose(image[0], 0, atol=1e-6)
    np.testing.assert_allclose(image[1], -0.456 / 0.224, rtol=1e-6)
    np.testing.assert_allclose(image[2], (1 - 0.406) / 0.225, rtol=1e-6)


def test_points_and_their_pixels():
    camera = Camera(640, 480, 500.0, 400.0, 320.0, 240.0)
    mask, depth = np.zeros((480, 640), bool), np.zeros((480, 640), np.float32)
    mask[250:260, 330:340] = True
    depth[250:260, 330:340] = 2.0
    depth[251] = 0
    crop = Crop(240, 320, 40, 40)
    rows, columns = depth_pixels(mask, depth, crop)
    assert len(rows) == 90
    assert (rows[0], columns[0], rows[10], columns[10]) == (10, 10, 12, 10)
    points = back_project(rows + 240, columns + 320, depth, camera)
    np.testing.assert_allclose(points[10], [10 * 2 / 500, 12 * 2 / 400, 2], rtol=1e-6)
    # 192 / 40 = 4.8 feature pixels per pixel
    assert feature_index(rows, columns, crop)[10] == 57 * 192 + 48


def test_sampling_rules():
    generator = np.random.default_rng(0)
    few, many = subset_in_order(400, generator), subset_in_order(5000, generator)
    assert few.tolist() == [*range(400), *range(400), *range(224)]
    assert len(many) == 1024
    assert (np.diff(many) > 0).all()
    few, many = Dpdn().pick(400, generator), Dpdn().pick(5000, generator)
    assert len(few) == len(many) == len(set(many)) == 1024
    assert (np.diff(many) < 0).any()
    assert len(set(few)) < 400


def test_fewer_than_32_depth_pixels():
    mask, depth = np.zeros((480, 640), bool), np.zeros((480, 640), np.float32)
    mask[100:140, 100:140] = True
    depth[100, 100:131] = 1
    crop = crop_of(mask)
    with pytest.raises(NoAnswerError, match="31 pixels of the mask have a depth"):
        depth_pixels(mask, depth, crop)
    depth[101, 100] = 1
    assert len(depth_pixels(mask, depth, crop)[0]) == 32


def test_depth_filling_as_opencv_recorded():
    """``recorded/depth.npz``: a depth image of 60 x 80 and what the same steps made with OpenCV
    5.0 operators (tests/ports/record_depth.py)."""
    with np.load(Path(__file__).with_name("recorded") / "depth.npz") as data:
        depth, expected = data["depth"], data["filled"]
    assert np.count_nonzero(depth == 0) > 1500
    np.testing.assert_allclose(fill_depth(depth), expected, atol=2e-5)


def moved(source, scale, rotation, translation):
    return scale * source @ rotation.T + translation


def test_similarity_is_recovered_and_optimal():
    random = np.random.default_rng(0)
    source = random.standard_normal((5, 40, 3))
    rotation = Rotation.random(5, rng=random).as_matrix()
    scale, translation = random.uniform(0.1, 3, 5), random.standard_normal((5, 3))
    target = scale[:, None, None] * (source @ rotation.mT) + translation[:, None]
    exact = umeyama(source, target)
    np.testing.assert_allclose(exact.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(exact.scale, scale)
    np.testing.assert_allclose(exact.translation, translation, atol=1e-12)
    # with noise nothing nearby is better
    target = target + 0.3 * random.standard_normal(target.shape)
    best = umeyama(source[0], target[0])
    error = np.square(best.residuals(source[0], target[0])).sum()
    for _ in range(200):
        turn = Rotation.from_rotvec(0.05 * random.standard_normal(3)).as_matrix()
        other = moved(
            source[0],
            best.scale * random.uniform(0.97, 1.03),
            turn @ best.rotation,
            best.translation + 0.02 * random.standard_normal(3),
        )
        assert np.square(other - target[0]).sum() > error


def test_similarity_of_a_mirrored_cloud_is_a_rotation():
    source = np.random.default_rng(0).standard_normal((40, 3))
    found = umeyama(source, source * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_similarity_with_outliers():
    random = np.random.default_rng(1)
    source = random.uniform(-0.5, 0.5, (300, 3))
    rotation = Rotation.random(rng=random).as_matrix()
    target = moved(source, 0.2, rotation, np.array([0.1, 0, 1]))
    wrong = random.random(300) < 0.4
    target[wrong] = random.uniform(-3, 3, (wrong.sum(), 3))
    found = robust_umeyama(source, target, np.random.default_rng(0))
    np.testing.assert_allclose(found.rotation, rotation, atol=0.02)
    assert found.scale == pytest.approx(0.2, rel=0.03)
    again = robust_umeyama(source, target, np.random.default_rng(0))
    assert np.array_equal(found.rotation, again.rotation)


def written_out(source, target, generator):
    """RANSAC by its description, hypothesis by hypothesis."""
    drawn = generator.integers(len(source), size=(128, 5))
    reach = 2 * max(np.linalg.norm(source - source.mean(axis=0), axis=1)) / 10
    best = np.zeros(len(source), bool)
    for tried, chosen in enumerate(drawn):
        hypothesis = umeyama(source[chosen], target[chosen])
        inliers = hypothesis.residuals(source, target) < hypothesis.scale * reach
        if inliers.sum() > best.sum():
            best = inliers
        if 1 - (1 - best.mean() ** 5) ** tried > 0.99:
            break
    return umeyama(source[best], target[best]), best.mean(), tried + 1


@pytest.mark.parametrize("wrong", [0.1, 0.2, 0.5, 0.7, 0.97])
def test_ransac_as_written_out(wrong):
    """In the first block of hypotheses, in a later one, in none."""
    random = np.random.default_rng(round(100 * wrong))
    source = random.uniform(-0.5, 0.5, (400, 3))
    target = moved(source, 0.2, np.eye(3), np.array([0.1, 0, 1]))
    outlier = random.random(400) < wrong
    target[outlier] = np.array([0.1, 0, 1]) + random.uniform(-0.3, 0.3, (outlier.sum(), 3))
    expected, share, tried = written_out(source, target, np.random.default_rng(0))
    if share < 0.1:
        told = f"{round(share * 400)} of 400 agree with the best of {tried},"
        with pytest.raises(NoSimilarityError, match=told):
            robust_umeyama(source, target, np.random.default_rng(0))
    else:
        found = robust_umeyama(source, target, np.random.default_rng(0))
        np.testing.assert_array_equal(found.rotation, expected.rotation)
        np.testing.assert_array_equal(found.translation, expected.translation)
        assert found.scale == expected.scale
    assert (tried <= 16) == (wrong < 0.3), tried


@pytest.mark.parametrize("source", ["noise", "one point", "nan"])
def test_no_similarity_is_said(source):
    random = np.random.default_rng(0)
    clouds = {
        "noise": random.uniform(-1, 1, (400, 3)),
        "one point": np.full((400, 3), 0.1) + 1e-9 * random.standard_normal((400, 3)),
        "nan": np.full((400, 3), np.nan),
    }
    target = random.standard_normal((400, 3)) ** 9
    with pytest.raises(NoSimilarityError, match=r"correspondences"):
        robust_umeyama(clouds[source], target, random)


@pytest.mark.parametrize("category", [0, 5])
def test_pose_from_a_known_assignment(category):
    """Every observed point is assigned to the deformed prior point that it shows."""
    random = np.random.default_rng(3)
    prior = random.uniform(-0.4, 0.4, (1024, 3)).astype(np.float32)
    deltas = 0.05 * random.standard_normal((1024, 3))
    shape = prior + deltas
    rotation, scale = Rotation.random(rng=random).as_matrix(), 0.21
    translation = np.array([0.1, -0.05, 0.9])
    seen = random.integers(0, 1024, 700)[np.arange(1024) % 700]
    assign = np.zeros((1024, 1024))
    assign[np.arange(1024), seen] = 60.0
    points = moved(shape[seen], scale, rotation, translation)
    choose = np.arange(1024) % 700
    points[700:] = 9  # repeated pixels, of which only the first occurrence may count
    inputs = Inputs(
        points.astype(np.float32),
        np.zeros((3, 192, 192), np.float32),
        choose,
        np.array(category),
        prior,
    )
    parts = (torch.from_numpy(x)[None] for x in (assign, prior, deltas))
    coordinates = assigned(*parts)[0].numpy()
    found = pose_from_coordinates(inputs, coordinates, deltas, np.random.default_rng(0))
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-5)
    # the mug's middle is moved to the origin; what is seen stays where it is
    offset = np.array([MUG_OFFSET if category == 5 else 0, 0, 0])
    np.testing.assert_allclose(found.points, scale * (shape - offset), atol=1e-5)
    np.testing.assert_allclose(found.pose.apply(found.points[seen[:700]]), points[:700], atol=1e-5)
    np.testing.assert_allclose(found.extents, 2 * np.abs(found.points).max(axis=0))
    assert np.allclose(found.translation, translation, atol=1e-3) != (category == 5)


def test_dpdn_answer():
    size = np.array([0.1, 0.2, 0.2])
    shape = cases.priors()[5]
    outputs = (shape, np.eye(3), np.array([0.0, 0, 1]), size)
    inputs = Inputs(*(np.zeros(1),) * 3, np.array(5), np.zeros(1))
    found = Dpdn().interpret(inputs, outputs, np.random.default_rng(0))
    # published: the mug's shape is recentred, its position is not
    np.testing.assert_allclose(found.points, 0.3 * (shape - [MUG_OFFSET, 0, 0]))
    np.testing.assert_array_equal(found.translation, [0, 0, 1])
    np.testing.assert_array_equal(found.extents, size)
    for bad in (-0.01, 0.0, np.nan):
        outputs = (*outputs[:3], np.array([0.1, bad, 0.2]))
        with pytest.raises(NoAnswerError, match="not positive"):
            Dpdn().interpret(inputs, outputs, np.random.default_rng(0))
