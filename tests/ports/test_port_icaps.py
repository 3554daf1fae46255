import copy
import dataclasses
import functools

import cases
import icaps_cases
import numpy as np
import parity
import pytest
import torch
from scipy.spatial.transform import Rotation

from method_adapters import _particle_filter, icaps
from method_adapters._assets import AssetError
from method_adapters._crop import NoAnswerError
from method_adapters._level_set import level_set
from method_adapters._networks import icaps as networks
from method_adapters._networks import icaps_matching, icaps_refinement, pointnet2, roi_align
from method_adapters._networks.icaps_matching import Codebook
from method_adapters._networks.icaps_refinement import Placed, Refiner
from method_adapters._particle_filter import View
from method_adapters.icaps import ICaps
from pytest_cpas.evaluation import check_answers
from pytest_cpas.types import Observation
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

real_roi_align = roi_align.roi_align
POSITION, UNIT = np.array([0.12, -0.06, 0.7]), 0.05


def degrees(a, b):
    return np.degrees(Rotation.from_matrix(a @ b.T).magnitude())


# ---- networks and operators


def test_every_output_of_the_original(shared_ports):
    data = parity.read(shared_ports, "icaps_nets")
    loaded = {}
    for name, make in icaps_cases.NETWORKS.items():
        loaded[name] = make().eval()
        loaded[name].load_state_dict(parity.weights(shared_ports, name, data), strict=True)
    given = {key.removeprefix("input__"): torch.from_numpy(data[key]) for key in data
             if key.startswith("input__")}  # fmt: skip
    with torch.inference_mode():
        code = loaded["icaps_aae"].encoder(given["aae_image"])
        seen = {
            "output__aae_code": code,
            "output__aae_recon": loaded["icaps_aae"].decoder(code),
            "output__latent": loaded["icaps_latentnet"](given["latentnet_points"])[0],
            "output__sdf": loaded["icaps_deepsdf"](given["deepsdf_latent"], given["deepsdf_query"]),
        }
    assert parity.compare(seen, data) == 4
    for level, index in enumerate(
        loaded["icaps_latentnet"].SAMPLING.levels(given["latentnet_points"])
    ):
        np.testing.assert_array_equal(index, data[f"aux__fps_latentnet_{level}"])
    assert level == 3
    # the same distances with the code's share computed once
    shape = networks.Shape(loaded["icaps_deepsdf"], given["deepsdf_latent"])
    again = shape.distances(given["deepsdf_query"])[:, None]
    assert parity.compare({**seen, "output__sdf": again}, data) == 4


def test_regions_as_the_original(shared_ports):
    data = parity.read(shared_ports, "roi_align")
    image, rois = torch.from_numpy(data["input__image"][0]), torch.from_numpy(data["input__rois"])
    assert not rois[:, 0].any()
    pooled = roi_align.roi_align(image, rois[:, 1:], 16)
    assert parity.compare({"output__pooled": pooled}, data) == 1


@pytest.mark.parametrize("name", icaps_cases.NETWORKS)
def test_recorded_networks(name):
    icaps_cases.check_network(name)


def sampled(image, x0, y0, x1, y1, side):
    """RoIAlign, sample by sample."""
    height, width = image.shape
    bins = np.zeros((side, side))
    steps = [max(b - a, 1) / side for a, b in ((x0, x1), (y0, y1))]
    counts = [int(np.ceil(step)) for step in steps]
    for row in range(side):
        for column in range(side):
            for i in range(counts[1]):
                for j in range(counts[0]):
                    x = x0 + steps[0] * (column + (j + 0.5) / counts[0])
                    y = y0 + steps[1] * (row + (i + 0.5) / counts[1])
                    if not (-1 <= x <= width and -1 <= y <= height):
                        continue
                    x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
                    u, v = min(int(x), width - 2), min(int(y), height - 2)
                    a, b = x - u, y - v
                    bins[row, column] += (
                        image[v, u] * (1 - a) * (1 - b) + image[v, u + 1] * a * (1 - b)
                        + image[v + 1, u] * (1 - a) * b + image[v + 1, u + 1] * a * b
                    )  # fmt: skip
    return bins / (counts[0] * counts[1])


def check_regions():
    random = np.random.default_rng(0)
    image = random.random((20, 30))
    regions = [[3.2, 4.1, 17.9, 12.3], [-8, -5, 9, 30.5], [5, 5, 5.2, 5.1], [28, -3, 36.5, 4]]
    rois = torch.tensor(regions, dtype=torch.float64)
    ours = roi_align.roi_align(torch.from_numpy(image)[None], rois, 4)[:, 0].numpy()
    for k, region in enumerate(regions):
        np.testing.assert_allclose(ours[k], sampled(image, *region, 4), atol=1e-6)


def test_regions_sample_by_sample():
    check_regions()


def check_gradients():
    """Of the recipe's decoder, whose code matters, against autograd; and the object's distance."""
    decoder = icaps_cases.network("icaps_deepsdf").requires_grad_(False)
    random = np.random.default_rng(0)
    latent = torch.from_numpy(random.standard_normal((1, 256)).astype(np.float32))
    points = torch.from_numpy(random.uniform(-1, 1, (50, 3)).astype(np.float32))
    points.requires_grad_()
    expected = decoder(latent, points)[:, 0]
    expected.sum().backward()
    distance, gradient = networks.Shape(decoder, latent).distances_and_gradients(points.detach())
    assert cases.relative(distance.numpy(), expected.detach().numpy()) <= cases.TOLERANCE
    assert cases.relative(gradient.numpy(), points.grad.numpy()) <= cases.TOLERANCE


def test_gradients_by_autograd():
    check_gradients()


def test_decoder_of_the_test_object_is_its_distance():
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3))
    shape = networks.Shape(icaps_cases.decoder(), torch.zeros(1, 256))
    ours = shape.distances(torch.from_numpy(points.astype(np.float32)))
    np.testing.assert_allclose(ours, np.tanh(icaps_cases.distance(points)), atol=1e-6)
    assert np.abs(icaps_cases.distance(icaps_cases.corners())).max() < 1e-12


# ---- what is seen


@pytest.fixture(scope="module")
def truth():
    near = icaps_cases.rotations()[7] * Rotation.from_rotvec([0.1, 0.05, -0.1])
    return near.as_matrix()


@pytest.fixture(scope="module")
def seen(truth):
    return icaps_cases.render(truth, POSITION, UNIT)


def test_view_of_the_mask_without_its_edge(seen):
    depth = seen.depth.copy()
    rows, columns = np.nonzero(seen.mask)
    depth[rows[0], columns[0]] = 0.3  # an edge pixel
    depth[rows[len(rows) // 2], columns[len(rows) // 2]] = 2.5  # too far
    view = View.of(
        Observation(category="mug", rgb=seen.rgb, depth=depth, mask=seen.mask, camera=seen.camera)
    )
    assert view.cloud[:, 2].min() > 0.6
    assert view.cloud[:, 2].max() < 0.8
    v, u = np.nonzero(view.depth)
    pixels = np.stack([u, v], axis=1) + view.corner
    np.testing.assert_allclose(seen.camera.project(view.cloud), pixels, atol=1e-9)
    np.testing.assert_allclose(view.cloud[:, 2], depth[pixels[:, 1].astype(int),
                                                       pixels[:, 0].astype(int)])  # fmt: skip


def test_particles_and_positions_are_inverse(seen):
    view = View.of(seen)
    particles = np.random.default_rng(0).uniform([0, 0, 0.3], [640, 480, 2], (20, 3))
    positions = view.positions(particles)
    np.testing.assert_allclose(view.particles(positions), particles)
    np.testing.assert_allclose(seen.camera.project(positions), particles[:, :2])


def check_crop():
    """A ball of 5 cm at 0.6 m fills its crop; its front is 0.0, its middle's depth 0.5."""
    camera = icaps_cases.CAMERA
    v, u = np.mgrid[:480, :640]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1 + 0 * u], -1)
    middle, radius = np.array([0, 0, 0.6]), 0.05
    a, b = (rays**2).sum(-1), rays @ middle
    inside = b**2 - a * (middle @ middle - radius**2)
    mask = inside > 0
    depth = np.where(mask, (b - np.sqrt(np.maximum(inside, 0))) / a, 0).astype(np.float32)
    rgb = np.zeros((*depth.shape, 3), np.float32)
    view = View.of(Observation(category="mug", rgb=rgb, depth=depth, mask=mask, camera=camera))
    region = view.regions(view.particles(middle[None]), np.array([radius]))
    image = torch.from_numpy(np.stack([view.depth, view.depth > 0]))
    crop = icaps_matching.normalised_crops(
        image, *(torch.tensor(x, dtype=torch.float32) for x in (region, [0.6], [radius]))
    )[0, 0].numpy()
    assert crop.shape == (128, 128)
    assert crop[62:66, 62:66].max() < 0.01
    assert crop[0].min() == crop[:, 0].min() == crop[-1].min() == crop[:, -1].min() == 1
    assert crop[10, 64] < 0.5
    # at 0.8 of the radius from the middle the surface is 0.6 radii nearer than the middle
    assert crop[64, 64 + 51] == pytest.approx(0.5 - 0.3, abs=0.04)
    assert crop[64 - 51, 64] == pytest.approx(0.5 - 0.3, abs=0.04)


def test_crop_of_a_ball():
    check_crop()


def test_too_little_depth_is_said(seen):
    for depth in (0 * seen.depth, seen.depth + np.float32(1.5)):
        shown = Observation(
            category="mug", rgb=seen.rgb, depth=depth, mask=seen.mask, camera=seen.camera
        )
        with pytest.raises(NoAnswerError, match=r"0 pixels within the mask have a depth from 0.2"):
            View.of(shown)


# ---- refinement


def check_refinement():
    """From 8 degrees and 8 mm beside, with a visible half that does not fix it by itself."""
    random = np.random.default_rng(1)
    sides = random.dirichlet(np.ones(3), 600) * np.sign(random.standard_normal((600, 3)))
    slopes = icaps_cases.SLOPES[[0, 2, 4]] * (sides > 0) + icaps_cases.SLOPES[[1, 3, 5]] * (
        sides <= 0
    )
    model = sides * icaps_cases.DEPTH / (np.abs(sides) * slopes).sum(1, keepdims=True)
    assert np.abs(icaps_cases.distance(model)).max() < 1e-9
    truth = Placed(Rotation.random(rng=2).as_matrix(), np.array([0.1, 0, 0.8]), 0.05)
    points = model[model @ truth.rotation.T @ truth.translation < 0.2] * truth.unit
    points = points @ truth.rotation.T + truth.translation
    tilt = Rotation.from_rotvec(np.deg2rad([5, -5, 4])).as_matrix()
    beside = truth.translation + np.array([0.005, -0.004, 0.005])
    start = Placed(truth.rotation @ tilt, beside, truth.unit)
    refiner = Refiner(icaps_cases.NoLatent(), icaps_cases.decoder(), 2.2)
    found, shape = refiner(points, start)
    assert degrees(found.rotation, truth.rotation) < 0.3
    np.testing.assert_allclose(found.translation, truth.translation, atol=2e-4)
    assert found.unit == truth.unit
    followed = refiner.follow(points, found, shape)
    assert degrees(followed.rotation, truth.rotation) < 0.3


def test_refinement_finds_the_pose():
    check_refinement()


@pytest.mark.minutes
def test_float_noise_is_within_what_is_declared():
    """What threads change in the last digits grows in the refinement, but not further."""
    random = np.random.default_rng(1)
    points = icaps_cases.corners()[random.integers(6, size=(600, 3))]
    points = (points * random.dirichlet(np.ones(3), 600)[..., None]).sum(1) * 0.08 + [0, 0, 0.7]
    start = Placed(Rotation.from_rotvec([0.2, 0.1, -0.2]).as_matrix(), np.array([0, 0, 0.71]), 0.08)
    refiner = Refiner(icaps_cases.NoLatent(), icaps_cases.decoder(), 2.2)
    shape = refiner.shape_of(torch.zeros((1, 3)))
    noisy = points * (1 + 1e-7 * random.standard_normal(points.shape))
    one, other = (refiner.follow(given, start, shape) for given in (points, noisy))
    assert degrees(one.rotation, start.rotation) > 3
    assert np.deg2rad(degrees(one.rotation, other.rotation)) < ICaps.info.tolerance
    np.testing.assert_allclose(one.translation, other.translation, atol=ICaps.info.tolerance)


def test_linear_between_evaluations_as_evaluated_always(monkeypatch):
    """On the same path as with an evaluation per step, within what a step may move."""
    poses = []
    for reach in (icaps_refinement.LINEAR_REACH, 0.0):
        monkeypatch.setattr(icaps_refinement, "LINEAR_REACH", reach)
        points = icaps_cases.corners() * 0.9 * 0.05 + np.array([0, 0, 0.7])
        start = Placed(Rotation.from_rotvec([0.08, 0.05, 0]).as_matrix(),
                       np.array([0.003, 0, 0.702]), 0.05)  # fmt: skip
        refiner = Refiner(icaps_cases.NoLatent(), icaps_cases.network("icaps_deepsdf"), 2.2)
        shape = refiner.shape_of(torch.zeros((1, 3)))
        poses.append(refiner.follow(points, start, shape))
    assert degrees(poses[0].rotation, start.rotation) > 5
    assert degrees(poses[0].rotation, poses[1].rotation) < 0.5
    assert np.linalg.norm(poses[0].translation - start.translation) > 0.01
    np.testing.assert_allclose(poses[0].translation, poses[1].translation, atol=2e-4)


def test_placement_after_a_motion():
    random = np.random.default_rng(0)
    placed = Placed(Rotation.random(rng=1).as_matrix(), random.standard_normal(3), 0.07)
    turn, shift = Rotation.random(rng=2).as_matrix(), random.standard_normal(3)
    points = random.standard_normal((10, 3))
    expected = placed.to_object(points) @ turn.T + shift
    np.testing.assert_allclose(placed.after(turn, shift).to_object(points), expected)


def test_repeated_points_count_as_often():
    given = np.random.default_rng(0).standard_normal((40, 3))
    placed = Placed(np.eye(3), np.zeros(3), 1.0)
    repeated = icaps_refinement._Increment(
        np.concatenate([given, given[:5]]), placed, torch.device("cpu")
    )
    assert len(repeated._points) == 40
    assert repeated._counts.sum() == 45
    assert repeated.coordinates().shape == (45, 3)


def test_spread_points():
    random = np.random.default_rng(0)
    few, many = random.standard_normal((700, 3)), random.standard_normal((5200, 3))
    points = icaps_refinement.spread(few, random)
    assert points.shape == (4873, 3)
    np.testing.assert_array_equal(points[:700], few)
    points = icaps_refinement.spread(many, random)
    assert len(np.unique(points, axis=0)) == 4873
    table = pointnet2.TABLE_POINTS
    assert table < 5200
    chosen = pointnet2.farthest_points(
        torch.from_numpy(many[:300]).float()[None], 60, max_threads=1024
    )
    try:
        pointnet2.TABLE_POINTS = 0
        again = pointnet2.farthest_points(
            torch.from_numpy(many[:300]).float()[None], 60, max_threads=1024
        )
    finally:
        pointnet2.TABLE_POINTS = table
    assert torch.equal(chosen, again)


def check_mesh():
    shape = networks.Shape(icaps_cases.decoder(), torch.zeros(1, 256))
    mesh = level_set(icaps_refinement.distance_grid(shape), 0, half_width=0.05, closed=False)
    assert np.abs(icaps_cases.distance(mesh.vertices / 0.05)).max() < 0.02
    corners = icaps_cases.corners() * 0.05
    low, high = mesh.bounds
    np.testing.assert_allclose(high, corners.max(axis=0), atol=0.05 * 0.06)
    np.testing.assert_allclose(low, corners.min(axis=0), atol=0.05 * 0.06)


def test_mesh_of_the_object():
    check_mesh()


class Exact:
    """Instead of a decoder: a distance function in closed form, (N, 3) to (N,)."""

    device = torch.device("cpu")

    def __init__(self, function):
        self.function, self.evaluated = function, 0

    def distances(self, points):
        self.evaluated += len(points)
        return torch.from_numpy(self.function(points.numpy().astype(float))).float()


def box(points, half):
    beyond = np.abs(points) - half
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def ring(points, radius, thickness):
    around = np.hypot(np.hypot(points[:, 0], points[:, 1]) - radius, points[:, 2])
    return around - thickness


SOLIDS = {
    "ball": lambda x: np.linalg.norm(x, axis=1) - 0.7,
    "small ball between coarse nodes": lambda x: np.linalg.norm(x - 0.516, axis=1) - 0.035,
    "sheet": lambda x: box(x, [0.6, 0.5, 0.02]),
    "turned sheet": lambda x: box(x @ Rotation.random(rng=4).as_matrix(), [0.6, 0.5, 0.015]),
    "ring": lambda x: ring(x @ Rotation.random(rng=5).as_matrix(), 0.6, 0.04),
    "bowl": lambda x: np.maximum(np.abs(np.linalg.norm(x, axis=1) - 0.7) - 0.03, x[:, 1] - 0.1),
    "up to the border": lambda x: box(x, [1.0, 0.4, 0.7]),
}


def check_grid_near_the_surface(name):
    """The published grid, evaluated near the surface alone, holds the mesh of the whole one; also
    of distances that end at 0.1, as decoders learn them."""
    whole = icaps_refinement._nodes(icaps_refinement.FINE, torch.device("cpu"))
    for reach in (9, icaps_refinement.CLAMP):
        shape = Exact(lambda x, reach=reach: SOLIDS[name](x).clip(-reach, reach))
        full = shape.distances(whole).view(64, 64, 64).numpy()
        shape.evaluated = 0
        quick = icaps_refinement.distance_grid(shape)
        assert shape.evaluated < 0.7 * len(whole)
        np.testing.assert_array_equal(quick > 0, full > 0)
        expected, found = (level_set(x, 0, half_width=1, closed=False) for x in (full, quick))
        np.testing.assert_array_equal(found.triangles, expected.triangles)
        np.testing.assert_array_equal(found.vertices, expected.vertices)


@pytest.mark.parametrize("name", SOLIDS)
def test_grid_evaluated_near_the_surface(name):
    check_grid_near_the_surface(name)


@pytest.mark.parametrize("name", ["ball", "turned sheet"])
def test_grid_evaluated_too_near_the_surface_is_found(monkeypatch, name):
    monkeypatch.setattr(icaps_refinement, "NEAR", 0.03)
    with pytest.raises(AssertionError):
        check_grid_near_the_surface(name)


# ---- the method


@pytest.fixture(scope="module")
def answer(seen):
    return icaps_cases.method().predict([seen], 0)[0]


def check_belief(truth):
    """Far from the optical axis, before any refinement."""
    at = np.array([0.2, -0.1, 0.7])
    view, matcher = View.of(icaps_cases.render(truth, at, UNIT)), icaps_cases.matcher()
    quaternions = matcher.codebook.quaternions
    belief = _particle_filter.first_belief(view, matcher, quaternions, np.random.default_rng(0))
    assert degrees(belief.rotation @ NOCS_FROM_SHAPENET, truth) < 14
    np.testing.assert_allclose(belief.translation, at, atol=0.01)
    assert belief.particles.shape == (100, 3)
    assert belief.weights.sum() == pytest.approx(1)
    assert 0.7 < belief.radius / UNIT < 1.1


@pytest.mark.minutes
def test_belief_far_from_the_axis(truth):
    check_belief(truth)


def check_single_view(predictions, truth):
    check_answers(predictions, ICaps.info)
    (found,) = predictions[0].hypotheses
    assert degrees(found.rotation, truth) < 3
    np.testing.assert_allclose(found.translation, POSITION, atol=0.006)
    # the size is that of what is seen, without the mask's edge
    size = found.extents / (2 * UNIT * np.abs(icaps_cases.corners()).max(axis=0))
    assert np.all((size > 0.7) & (size < 1.1))


def test_single_view(answer, truth):
    check_single_view([answer], truth)


def on_the_arc(truth, i):
    """Pose of the object in frame ``i``: it turns by 4 degrees and moves by 1 cm per frame."""
    turned = Rotation.from_rotvec([0, 0.06 * i, 0.03 * i]).as_matrix() @ truth
    return turned, POSITION + i * np.array([0.006, 0.003, -0.008])


@pytest.fixture(scope="module")
def frames(truth):
    return [icaps_cases.render(*on_the_arc(truth, i), UNIT) for i in range(4)]


def check_path(predictions, truth):
    for i, prediction in enumerate(predictions):
        (found,), (rotation, translation) = prediction.hypotheses, on_the_arc(truth, i)
        assert degrees(found.rotation, rotation) < 1
        np.testing.assert_allclose(found.translation, translation, atol=0.008)


@pytest.mark.minutes
def test_tracking(truth, frames):
    """Along an arc every pose is found; the shape stays, and is estimated once."""
    method = icaps_cases.method()
    _, refiner = method._networks["mug"]
    shapes, real = [], refiner.shape_of
    refiner.shape_of = lambda points: shapes.append(points) or real(points)
    predictions = method.track(frames, 0)
    check_path(predictions, truth)
    assert len(shapes) == icaps_refinement.ROUNDS
    assert len({id(p.hypotheses[0].mesh) for p in predictions}) == 1


def same(a, b):
    parts = ("rotation", "translation", "extents")
    return all(np.array_equal(getattr(a, part), getattr(b, part)) for part in parts)


def test_first_frame_is_a_single_view(frames, quick):
    """And a sequence knows nothing of the one before."""
    method = icaps_cases.method()
    (alone,), (first, second) = method.predict(frames[:1], 0), method.track(frames[:2], 0)
    (again,) = method.track(frames[:1], 0)
    assert same(alone.hypotheses[0], first.hypotheses[0])
    assert same(alone.hypotheses[0], again.hypotheses[0])
    (unknown,) = method.predict(frames[1:2], 0)
    assert not same(second.hypotheses[0], unknown.hypotheses[0])


def test_what_is_known_is_carried_over(truth, frames, quick, monkeypatch):
    """Particles, size and rotation of the last frame are where the next one begins."""
    method = icaps_cases.method()
    beliefs, real = [], icaps.next_belief

    def seen_by(view, last, *given):
        beliefs.append((last, real(view, last, *given)))
        return beliefs[-1][1]

    monkeypatch.setattr(icaps, "next_belief", seen_by)
    found = [prediction.hypotheses[0] for prediction in method.track(frames[:3], 0)]
    assert len(beliefs) == 2
    for i, (last, belief) in enumerate(beliefs):
        np.testing.assert_allclose(last.translation, found[i].translation)
        np.testing.assert_allclose(last.rotation @ NOCS_FROM_SHAPENET, found[i].rotation)
        assert belief.radius == pytest.approx(last.radius)
        assert len(belief.particles) == _particle_filter.NEXT_PARTICLES
    # with the last rotation known, one opposite to it is not believed, whatever the crops say
    last = beliefs[0][0]
    assert degrees(beliefs[0][1].rotation, last.rotation) < 20


def forgotten(patch):
    real = icaps.next_belief

    def fault(view, last, *given):
        return real(view, dataclasses.replace(last, seen=last.seen - 0.1), *given)

    patch(icaps, "next_belief", fault)


def shape_not_followed(patch):
    patch(Refiner, "follow", lambda self, points, placed, shape: placed)


@pytest.mark.minutes
@pytest.mark.parametrize("plant", [forgotten, shape_not_followed])
def test_planted_fault_in_tracking_is_found(monkeypatch, plant, truth, frames):
    method = icaps_cases.method()
    plant(monkeypatch.setattr)
    with pytest.raises(AssertionError):
        check_path(method.track(frames[:2], 0), truth)


def test_frames_of_two_categories_are_no_sequence(seen):
    can = dataclasses.replace(seen, category="can")
    with pytest.raises(ValueError, match="frames of can, mug: a sequence shows one object"):
        icaps_cases.method().track([seen, can], 0)


@pytest.fixture
def quick(monkeypatch):
    """Where it is not the answer that matters."""
    for name, value in (("ROUNDS", 1), ("STEPS", 2), ("COARSE", 16), ("FINE", 24)):
        monkeypatch.setattr(icaps_refinement, name, value)
    monkeypatch.setattr(_particle_filter, "FIRST_PARTICLES", 40)
    monkeypatch.setattr(_particle_filter, "NEXT_PARTICLES", 20)


def test_lost_and_found(seen, quick):
    """A frame without an answer says why, and the next one is a first one."""
    method = icaps_cases.method()
    nothing = Observation(
        category="mug", rgb=seen.rgb, depth=0 * seen.depth, mask=seen.mask, camera=seen.camera
    )
    first, lost, again = method.track([seen, nothing, seen], 0)
    assert lost.reason.startswith("0 pixels within the mask")
    assert first.hypotheses[0].mesh is not again.hypotheses[0].mesh
    assert again.hypotheses


def test_errors_are_reported_and_seeds_repeat(seen, quick):
    method = icaps_cases.method()
    teapot = Observation(
        category="teapot", rgb=seen.rgb, depth=seen.depth, mask=seen.mask, camera=seen.camera
    )
    small = cases.observation("mug", (300, 200), 4)
    strange, few, one = method.predict([teapot, small, seen], 0)
    assert strange.reason.startswith("category 'teapot': icaps knows bottle,")
    assert "expected at least 32" in few.reason
    (same,), (other,) = method.predict([seen], 0), method.predict([seen], 1)
    for part in ("rotation", "translation", "extents"):
        a, b, c = (getattr(x.hypotheses[0], part) for x in (one, same, other))
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, c)
    matcher, _ = method._networks["mug"]

    def broken(*arguments):
        raise RuntimeError("out of memory")

    method._networks["mug"] = (matcher, broken)
    with pytest.raises(RuntimeError, match="out of memory"):  # never a dummy answer
        method.predict([seen], 0)


def test_a_shape_without_surface_is_no_answer(seen, quick):
    method = icaps_cases.method()
    empty = copy.deepcopy(icaps_cases.decoder())
    empty.lin8.bias.data.fill_(0.1)
    refiner = Refiner(icaps_cases.NoLatent(), empty, 2.2)
    method._networks["mug"] = (method._networks["mug"][0], refiner)
    (prediction,) = method.predict([seen], 0)
    assert prediction.reason.startswith("no surface at 0")


# ---- files


def test_loaded_from_files(tmp_path, quick):
    method = ICaps()
    folder = icaps_cases.write_assets(tmp_path)
    method.load(folder, "cpu")
    (prediction,) = method.predict([cases.observation("can", (300, 200), 20)], 0)
    check_answers([prediction], method.info)
    assert prediction.hypotheses
    matcher, refiner = method._networks["can"]
    assert list(method._networks) == ["can"]
    for ours, expected in (
        (matcher._encoder, icaps_cases.network("icaps_aae").encoder),
        (refiner._latent_net, icaps_cases.network("icaps_latentnet")),
        (refiner._decoder, icaps_cases.decoder_with_code()),
    ):
        for key, value in expected.state_dict().items():
            assert torch.equal(ours.state_dict()[key], value), key
    asset = method.info.assets[-1]
    (folder / asset.path).unlink()
    with pytest.raises(FileNotFoundError) as caught:
        ICaps().load(folder, "cpu")
    for word in (str(folder / asset.path), asset.url, "no licence stated", "--cpas-weights"):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (torch.zeros((5, 128)), "it holds a Tensor"),
        ((torch.zeros((5, 128)), torch.zeros((4, 7))), r"\(5, 128\) and \(4, 7\)"),
        ((torch.zeros((5, 64)), torch.zeros((5, 7))), r"\(5, 64\) and \(5, 7\)"),
        ((torch.zeros((5, 128)), torch.zeros((5, 7))), "lengths 0 to 0"),
        ((torch.full((5, 128), torch.nan), torch.ones((5, 7)) / 2), "finite codes"),
    ],
)
def test_codebook_that_is_none(tmp_path, content, words):
    torch.save(content, tmp_path / "codebook.pth")
    with pytest.raises(AssetError, match=words):
        Codebook(tmp_path / "codebook.pth", torch.device("cpu"))


def test_codebook(tmp_path):
    codes, poses = icaps_cases.codebook()
    torch.save((codes[None, None], poses), tmp_path / "codebook.pth")
    book = Codebook(tmp_path / "codebook.pth", torch.device("cpu"))
    np.testing.assert_allclose(book.quaternions, poses[:, 3:], atol=1e-6)
    np.testing.assert_allclose(book.codes.norm(dim=1), 1, rtol=1e-5)
    np.testing.assert_allclose(book.codes[3] * codes[3].norm(), codes[3], rtol=1e-4)


# ---- planted faults


def latent_last(patch):
    real = networks.DeepSdf.forward
    patch(networks.DeepSdf, "forward", lambda self, z, x: real(self, z.roll(3, 1), x))


def tanh_left_out(patch):
    patch(torch, "tanh", lambda x: x)


def lengths_of_rows_ignored(patch):
    patch(networks.WeightNormLinear, "weight", property(lambda self: self.weight_v))


def first_points_sampled(patch):
    patch(
        pointnet2,
        "farthest_points",
        lambda xyz, count, **_: torch.arange(count).expand(len(xyz), -1),
    )


def codes_of_channels_last(patch):
    real = torch.Tensor.flatten

    def fault(self, *dims):
        return real(self.permute(0, 2, 3, 1) if self.dim() == 4 else self, *dims)

    patch(torch.Tensor, "flatten", fault)


def half_a_pixel_shift(patch):
    patch(roi_align, "roi_align", lambda image, rois, side: real_roi_align(image, rois - 0.5, side))


def one_sample_per_bin(patch):
    patch(torch, "ceil", torch.ones_like)


def gradient_without_tanh(patch):
    patch(torch.Tensor, "square", lambda self: torch.zeros_like(self))


def object_seen_along_the_axis(patch):
    patch(_particle_filter, "towards", lambda position: np.eye(3))


def axes_of_nocs(patch):
    patch(icaps, "NOCS_FROM_SHAPENET", np.eye(3))


def turned_the_other_way(patch):
    real = Placed.after
    patch(Placed, "after", lambda self, turn, shift: real(self, turn.T, shift))


def shift_in_metres(patch):
    real = Placed.after
    patch(Placed, "after", lambda self, turn, shift: real(self, turn, shift / self.unit))


def not_refined(patch):
    patch(icaps_refinement, "STEPS", 0)


def empty_pixels_are_near(patch):
    patch(icaps_matching, "BACKGROUND", 0.0)


def depth_of_the_edge_mixed(patch):
    real = roi_align.roi_align

    def fault(image, rois, side):
        return torch.where(image[1].sum() > 0, real(image, rois, side), 0) * torch.tensor(
            [1.0, 0.8]
        ).view(1, 2, 1, 1)

    patch(icaps_matching, "roi_align", fault)


def mesh_axes_exchanged(patch):
    real = icaps_refinement._nodes
    patch(icaps_refinement, "_nodes", lambda count, device: real(count, device).flip(1))


def mesh_upside_down(patch):
    real = icaps_refinement._nodes
    patch(icaps_refinement, "_nodes", lambda count, device: -real(count, device))


@pytest.mark.parametrize(
    ("check", "plant"),
    [
        (functools.partial(icaps_cases.check_network, "icaps_deepsdf"), latent_last),
        (functools.partial(icaps_cases.check_network, "icaps_deepsdf"), tanh_left_out),
        (functools.partial(icaps_cases.check_network, "icaps_deepsdf"), lengths_of_rows_ignored),
        (functools.partial(icaps_cases.check_network, "icaps_latentnet"), first_points_sampled),
        (functools.partial(icaps_cases.check_network, "icaps_aae"), codes_of_channels_last),
        (check_regions, half_a_pixel_shift),
        (check_regions, one_sample_per_bin),
        (check_gradients, gradient_without_tanh),
        (check_refinement, turned_the_other_way),
        (check_refinement, shift_in_metres),
        (check_refinement, not_refined),
        (check_crop, empty_pixels_are_near),
        (check_crop, depth_of_the_edge_mixed),
        (check_mesh, mesh_axes_exchanged),
        (check_mesh, mesh_upside_down),
    ],
    ids=lambda value: getattr(value, "__name__", "check_network"),
)
def test_planted_fault_is_found(monkeypatch, check, plant):
    for name in icaps_cases.NETWORKS:
        icaps_cases.network(name)  # made before anything is broken
    icaps_cases.decoder()
    plant(monkeypatch.setattr)
    with pytest.raises(AssertionError):
        check()


def unweighted(patch):
    patch(_particle_filter, "SIMILARITY_NOISE", 1e3)


@pytest.mark.parametrize("plant", [object_seen_along_the_axis, unweighted])
def test_planted_fault_in_the_filter_is_found(monkeypatch, plant, truth):
    icaps_cases.matcher()
    plant(monkeypatch.setattr)
    with pytest.raises(AssertionError):
        check_belief(truth)


def test_planted_fault_in_the_frame_is_found(monkeypatch, quick, truth, seen):
    method = icaps_cases.method()
    axes_of_nocs(monkeypatch.setattr)
    with pytest.raises(AssertionError):
        check_single_view(method.predict([seen], 0), truth)
