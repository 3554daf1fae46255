from dataclasses import replace

import numpy as np
import pytest
import sdfest_cases as own
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from test_port_sdf_renderer import interpolated_plainly

from method_adapters import sdfest
from method_adapters._crop import NoAnswerError
from method_adapters._sdf_renderer import Placement, rotation_matrix
from method_adapters._sdfest_estimation import Estimate, View, first_estimate, refine
from method_adapters._so3_grid import rotation_grid
from pytest_cpas.datasets.nocs import REAL_CAMERA, Real275
from pytest_cpas.datasets.rendering import hidden, render
from pytest_cpas.evaluation import check_answers, measure
from pytest_cpas.reading.images import read_depth
from pytest_cpas.types import CATEGORIES, ContractError, Observation, Pose, Sample, SampleRef
from pytest_cpas.types.frames import NOCS_FROM_SHAPENET

HERE = Pose(np.eye(3), np.zeros(3))


def second_camera():
    """60 degrees around the object."""
    turn = Rotation.from_euler("y", 60, degrees=True).as_matrix()
    middle = np.array([0.0, 0.0, 0.6])
    return Pose(turn, middle - turn @ middle)


def errors(hypothesis, category):
    """Of the position in mm, of the rotation in degrees, of the extents as a share."""
    truth, axes = own.true_pose(), own.AXES[category]
    rotation = truth.rotation @ axes.T
    turn = Rotation.from_matrix(hypothesis.rotation @ rotation.T)
    # the surface is taken a little outside of the decoded zero
    extents = np.abs(axes) @ (2 * own.HALF_WIDTH * (own.HALF_AXES + sdfest.LEVEL))
    return (
        1000 * np.linalg.norm(hypothesis.translation - truth.translation),
        np.degrees(turn.magnitude()),
        np.abs(hypothesis.extents / extents - 1).max(),
    )


def check_one_view():
    """50 steps bring the estimate nearer, and the surface to the points."""
    seen = own.observation("bowl")
    method = own.method()
    (prediction,) = method.predict([seen], 0)
    (found,) = prediction.hypotheses
    millimetres, degrees, share = errors(found, "bowl")
    assert millimetres < 9.5  # 20 at the start
    assert degrees < 6.5  # 8 at the start
    assert share < 0.15
    points = seen.camera.back_project(seen.depth, seen.mask)
    distance = cKDTree(found.pose.apply(found.points)).query(points)[0]
    assert np.median(distance) < 0.005  # rays end 3 mm early, and the level is at 2.4 mm


def check_two_views():
    """Two views and more steps leave nothing open."""
    method = own.method()
    method.iterations = 150
    views = [
        (own.observation("mug"), HERE),
        (own.observation("mug", second_camera()), second_camera()),
    ]
    (found,) = method.predict_views(views, 0).hypotheses
    millimetres, degrees, share = errors(found, "mug")
    assert millimetres < 1
    assert degrees < 0.5
    assert share < 0.02
    expected = np.linalg.norm(own.AXES["mug"].T @ found.mesh.vertices.T, axis=0)
    assert expected.max() == pytest.approx(found.extents.max() / 2, rel=0.01)


def test_one_view():
    check_one_view()


def test_two_views():
    check_two_views()


def written_out(vae, start, views, iterations):
    """The refinement by its description: Adam by its formulas, tracing in lockstep."""
    rates = {"latent": 1e-2, "position": 1e-3, "quaternion": 1e-2, "half_width": 1e-3}
    parts = {k: v.clone() for k, v in start._asdict().items()}
    first = {k: torch.zeros_like(v) for k, v in parts.items()}
    second = {k: torch.zeros_like(v) for k, v in parts.items()}
    for step in range(1, iterations + 1):
        leaves = {k: v.clone().requires_grad_() for k, v in parts.items()}
        sdf = vae(leaves["latent"][None])[0, 0]
        half_width = leaves["half_width"]
        loss = 0.0
        for view in views:
            place = Placement(
                view.rotation.T @ (leaves["position"] - view.position),
                view.rotation.T @ rotation_matrix(leaves["quaternion"]),
                half_width,
            )
            at = (view.points - place.position) @ place.rotation
            inside = (at.abs() < half_width).all(-1)
            near = interpolated_plainly(sdf, place, view.points)
            loss = loss + 3 * torch.where(inside, near, 0.0).abs().sum() / len(view.points)
            # every ray in steps of its own, from the cube's first face to its last
            local = view.directions @ place.rotation
            origin = -(place.position @ place.rotation)
            faces = torch.stack([(side * half_width - origin) / local for side in (-1, 1)])
            length, last = faces.amin(0).amax(-1).detach(), faces.amax(0).amin(-1).detach()
            found = torch.zeros_like(length)
            active = length < last
            while active.any():
                distance = interpolated_plainly(sdf, place, length[:, None] * view.directions)
                distance = distance.detach()
                ends = active & (distance < 0.005 * length)
                found = torch.where(ends, length, found)
                active = active & ~ends
                length = torch.where(active, length + distance, length)
                active = active & (length < last)
            hit = found > 0
            ends = found[hit, None] * view.directions[hit]
            away = found[hit] + interpolated_plainly(sdf, place, ends)
            away = away - (away - found[hit]).detach()
            depth = -view.directions[hit, 2] * away
            loss = loss + (depth + view.points[hit, 2]).abs().mean()
        loss.backward()
        for key, leaf in leaves.items():
            first[key] = 0.9 * first[key] + 0.1 * leaf.grad
            second[key] = 0.999 * second[key] + 0.001 * leaf.grad**2
            mean, square = first[key] / (1 - 0.9**step), second[key] / (1 - 0.999**step)
            parts[key] = parts[key] - rates[key] * mean / (square.sqrt() + 1e-8)
        parts["quaternion"] = parts["quaternion"] / parts["quaternion"].norm()
    return Estimate(**parts)


def view_of(seen, camera, dtype, every=3):
    """By the description: OpenGL axes; only some of the pixels, to be quick."""
    opengl = np.diag([1.0, -1.0, -1.0])
    points = seen.camera.back_project(seen.depth, seen.mask)[::every] @ opengl
    parts = (
        points / np.linalg.norm(points, axis=1, keepdims=True),
        points,
        camera.rotation @ opengl,
        camera.translation,
    )
    return View(*(torch.tensor(part, dtype=dtype) for part in parts))


def check_steps():
    """Six steps, two views, double precision."""
    quaternion = Rotation.from_matrix(own.true_pose().rotation).as_quat()
    start = Estimate(
        torch.tensor([0.1, -0.05, 0.05], dtype=torch.float64),
        torch.tensor([0.06, -0.03, 0.62], dtype=torch.float64),
        torch.tensor(quaternion + np.array([0.1, 0, 0, 0])) / 1.1,
        torch.tensor(0.1, dtype=torch.float64),
    )
    views = [
        view_of(own.observation(), HERE, torch.float64),
        view_of(own.observation(camera=second_camera()), second_camera(), torch.float64),
    ]
    vae = own.Ellipsoids(torch.float64)
    expected = written_out(vae, start, views, 6)
    found = refine(vae, start, views, 6, "correct")
    for ours, theirs, before in zip(found, expected, start, strict=True):
        assert (ours - before).norm() > 1e-3
        torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9)


def test_steps_as_written_out():
    check_steps()


def check_view():
    seen, camera = own.observation(), second_camera()
    expected = view_of(seen, camera, torch.float32, every=1)
    for ours, theirs in zip(own.method()._view(seen, camera), expected, strict=True):
        torch.testing.assert_close(ours, theirs)


def test_view():
    check_view()


def check_first_estimate():
    """The network sees points less their mean; what it says is put where the camera is."""
    guess, camera = own.Guess(), second_camera()
    seen = own.observation(camera=camera)
    view = view_of(seen, camera, torch.float32)
    found = first_estimate(guess, rotation_grid(1), view)
    assert guess.seen.mean(1).abs().max() < 1e-6
    opengl = np.diag([1.0, -1.0, -1.0])
    points = seen.camera.back_project(seen.depth, seen.mask)[::3]
    middle = points.mean(axis=0) + opengl @ [0.01, -0.005, -0.05]
    np.testing.assert_allclose(found.position, camera.apply(middle), atol=1e-6)
    cell = Rotation.from_quat([0.905061191828, 0.105662432703, 0.394337567297, -0.119153566374])
    expected = camera.rotation @ opengl @ cell.as_matrix()
    np.testing.assert_allclose(rotation_matrix(found.quaternion), expected, atol=1e-6)


def test_first_estimate():
    check_first_estimate()


def test_published_gradient_changes_the_latent_alone_at_first():
    """One step: the wrong order moves the shape elsewhere, pose and size as before."""
    view = view_of(own.observation(), HERE, torch.float64)
    first = first_estimate(
        own.Guess(), rotation_grid(1), view_of(own.observation(), HERE, torch.float32)
    )
    start = Estimate(*(part.double() for part in first))
    vae = own.Ellipsoids(torch.float64)
    found = [refine(vae, start, [view], 3, gradient) for gradient in ("correct", "published")]
    assert (found[0].latent - found[1].latent).norm() > 1e-6
    one = [refine(vae, start, [view], 1, gradient) for gradient in ("correct", "published")]
    for part in ("position", "quaternion", "half_width"):
        torch.testing.assert_close(getattr(one[0], part), getattr(one[1], part))


def test_view_without_overlap_pulls_by_its_points():
    """No ray meets the estimate: no NaN, as a mean of nothing would be."""
    view = view_of(own.observation(), HERE, torch.float32)
    start = Estimate(
        torch.zeros(3), torch.tensor([0.5, 0.4, 0.9]), torch.ones(4) / 2, torch.tensor(0.1)
    )
    found = refine(own.Ellipsoids(), start, [view], 3, "correct")
    assert all(part.isfinite().all() for part in found)


def test_answer_keeps_the_contract_and_repeats_with_its_seed():
    method, seen = own.method(), own.observation()
    method.iterations = 2
    few = Observation(
        category="bowl",
        rgb=seen.rgb,
        depth=seen.depth,
        mask=seen.mask & (np.arange(160) < 72),
        camera=seen.camera,
    )
    far = Observation(
        category="bowl", rgb=seen.rgb, depth=seen.depth + 2, mask=seen.mask, camera=seen.camera
    )
    can = Observation(
        category="can", rgb=seen.rgb, depth=seen.depth, mask=seen.mask, camera=seen.camera
    )
    answers = method.predict([few, seen, far, can], 3)
    again = method.predict([seen], 3)
    check_answers(again, method.info)
    for part in ("rotation", "translation", "extents", "points"):
        np.testing.assert_array_equal(
            getattr(answers[1].hypotheses[0], part), getattr(again[0].hypotheses[0], part)
        )
    other = method.predict([seen], 4)[0].hypotheses[0]
    assert not np.array_equal(other.points, again[0].hypotheses[0].points)
    assert len(other.points) == 10_000
    np.testing.assert_array_equal(other.mesh.vertices, again[0].hypotheses[0].mesh.vertices)
    assert "expected at least 32" in answers[0].reason
    assert answers[2].reason.startswith("0 pixels of the mask have a depth")
    assert "category 'can': sdfest knows bottle, bowl, mug" in answers[3].reason
    assert method.predict([], 3) == []


def check_far_pixels():
    method, seen = own.method(), own.observation()
    method.iterations = 2
    depth = seen.depth.copy()
    depth[seen.mask & (np.arange(160) < 75)] = 2.01
    behind = Observation(
        category="bowl", rgb=seen.rgb, depth=depth, mask=seen.mask, camera=seen.camera
    )
    missing = Observation(
        category="bowl", rgb=seen.rgb, depth=depth * (depth < 2), mask=seen.mask, camera=seen.camera
    )
    a, b = (method.predict([x], 0)[0].hypotheses[0].translation for x in (behind, missing))
    np.testing.assert_array_equal(a, b)


def test_far_pixels_are_left_out():
    check_far_pixels()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"half_width": torch.tensor(-0.01)}, "half-width of the volume became -0.01 m"),
        ({"half_width": torch.tensor(torch.nan)}, "half-width of the volume became nan m"),
        ({"latent": torch.full((3,), -9.0)}, "no surface at 0.02"),
        ({"latent": torch.full((3,), torch.nan)}, "no surface at 0.02"),
    ],
)
def test_estimates_without_a_surface_are_failures(changed, words):
    estimate = Estimate(torch.zeros(3), torch.zeros(3), torch.ones(4) / 2, torch.tensor(0.1))
    with pytest.raises(NoAnswerError, match=words):
        sdfest.reconstruct(own.Ellipsoids(), estimate._replace(**changed))


def test_views_are_of_one_object():
    method = own.method()
    for views in ([], [(own.observation("mug"), HERE), (own.observation("bowl"), HERE)]):
        with pytest.raises(ContractError, match="expected views of one object"):
            method.predict_views(views, 0)


@pytest.mark.parametrize("axis", range(3))
def test_world_frame_is_where_the_cameras_say(axis):
    """The same view in a shifted world, turned by half, so that Adam steps along the same axes."""
    method, seen = own.method(), own.observation()
    method.iterations = 3
    camera = Pose(np.diag(2 * np.eye(3)[axis] - 1), [0.3, -0.2, 0.5])
    (here,) = method.predict([seen], 0)[0].hypotheses
    (there,) = method.predict_views([(seen, camera)], 0).hypotheses
    expected = camera.apply(here.translation)
    np.testing.assert_allclose(there.translation, expected, rtol=0, atol=1e-6)
    turn = Rotation.from_matrix(there.rotation.T @ camera.rotation @ here.rotation)
    assert np.degrees(turn.magnitude()) < 0.01


@pytest.fixture(scope="module")
def trained(test_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("weights")
    (folder / "sdfest").symlink_to(test_data / "weights" / "sdfest_v1")
    method = sdfest.Sdfest()
    method.load(folder, "cpu")
    return method


def test_trained_shapes_stand_upright(trained):
    """In ShapeNet axes: bottles narrow at the top, bowls open there, mugs with the handle at -z."""
    for category, model in trained._models.items():
        estimate = Estimate(
            torch.zeros(8), torch.zeros(3), torch.tensor([0.0, 0, 0, 1]), torch.tensor(1.0)
        )
        mesh = sdfest.reconstruct(model.vae, estimate)
        found = sdfest.interpret(estimate, mesh, model.axes, 0)
        points = found.points / found.extents
        radius = np.hypot(points[:, 0], points[:, 2])
        top, bottom = (np.median(radius[s * points[:, 1] > 0.4]) for s in (1, -1))
        if category == "mug":
            assert found.points[:, 2].mean() > 0.03 > abs(found.points[:, 0].mean())
        else:
            assert (top < 0.7 * bottom) if category == "bottle" else (top > 1.1 * bottom)


def judged(method, sample):
    prediction = check_answers(method.predict([sample.observation], 0), method.info)
    names = ["position_m", "rotation_deg", "fscore_1cm"]
    [answer] = measure(names, [sample.truth], [prediction], method.info)
    return answer.facts


def test_real_frame(trained, test_data):
    """scene_1/0000 with its published masks."""
    data = Real275(test_data / "real275")
    samples = [data.load(ref) for ref in data.samples if ref.category in trained.info.categories]
    bowl, mug = (judged(trained, sample) for sample in samples)
    assert [sample.ref.category for sample in samples] == ["bowl", "mug"]
    assert bowl["position_m"] < 0.02
    assert bowl["rotation_deg"] < 10
    assert bowl["fscore_1cm"] > 0.8
    assert mug["fscore_1cm"] > 0.8  # its handle is on the other side


def test_real_frame_with_rendered_masks(trained, test_data):
    """scene_1/0006, whose mask is not at hand: what is seen of the meshes at their true poses."""
    root = test_data / "real275"
    data = Real275(root)
    truths = {ref.category: data.truth(ref) for ref in data.samples}
    image = root / "real_test" / "scene_1" / "0006_depth.png"
    depth = read_depth(image, REAL_CAMERA)
    with np.load(test_data / "predictions" / "dualposenet_real275.npz") as stored:
        frame = int(np.flatnonzero(stored["frame"] == "scene_1_0006")[0])
        rows = slice(*stored["gt_offset"][frame : frame + 2])
        classes, poses = stored["gt_class_ids"][rows], stored["gt_RTs"][rows]
    rows = {}
    for category in ("bowl", "mug"):
        (row,) = np.flatnonzero(classes == CATEGORIES.index(category) + 1)
        scaled = poses[row]
        turn = scaled[:3, :3] / np.cbrt(np.linalg.det(scaled[:3, :3])) @ NOCS_FROM_SHAPENET
        truth = replace(truths[category], pose=Pose(turn, scaled[:3, 3]))
        rendered = render([(truth.surface, truth.pose)], REAL_CAMERA).depth
        mask = (rendered > 0) & ~hidden(rendered, depth)
        assert mask.sum() > 1000
        rgb = np.zeros((480, 640, 3), np.float32)
        seen = Observation(category=category, rgb=rgb, depth=depth, mask=mask, camera=REAL_CAMERA)
        ref = SampleRef(id=f"scene_1/0006/{category}", category=category, scene="scene_1")
        rows[category] = judged(trained, Sample(ref, seen, truth))
    # the bowl is tilted by 26 degrees, the mug's handle is on the other side: local minima
    assert rows["bowl"]["position_m"] < 0.02
    for row in rows.values():
        assert row["fscore_1cm"] > 0.75
