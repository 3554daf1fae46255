import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from method_adapters._sdf_renderer import (
    Placement,
    distances,
    ray_depths,
    ray_directions,
    render_depth,
    rotation_matrix,
)
from pytest_cpas.types import Camera

CAMERA = Camera(96, 72, 90.0, 91.0, 48.3, 34.2)


def grid(side=64, dtype=torch.float64):
    axis = torch.linspace(-1, 1, side, dtype=dtype)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def ball(radius=0.6, dtype=torch.float64):
    return grid(dtype=dtype).norm(dim=-1) - radius


def place(position, quaternion, half_width, dtype=torch.float64):
    position, quaternion, half_width = (
        torch.tensor(value, dtype=dtype) for value in (position, quaternion, half_width)
    )
    return Placement(position, rotation_matrix(quaternion), half_width)


@pytest.fixture
def published(shared_ports):
    with np.load(shared_ports / "parity" / "sdf_renderer.npz") as file:
        return dict(file)


@pytest.mark.parametrize("gradient", ["published", "correct"])
def test_published_kernel(published, gradient):
    """Depth to 1e-6 m; gradients as float32 sums over 779 rays allow."""
    names = ("sdf", "position", "quaternion", "inv_scale")
    given = {n: torch.from_numpy(published[f"input__{n}"]).clone().requires_grad_() for n in names}
    width, height = published["input__image_size_wh"].tolist()
    fx, fy, cx, cy = published["input__fx_fy_cx_cy"].tolist()
    # the kernel has pixel centres at halves
    camera = Camera(width, height, fx, fy, cx - 0.5, cy - 0.5)
    where = Placement(
        given["position"], rotation_matrix(given["quaternion"]), 1 / given["inv_scale"]
    )
    threshold = float(published["input__threshold"])
    depth = render_depth(given["sdf"], where, camera, threshold, gradient)
    np.testing.assert_allclose(depth.detach(), published["output__depth"], rtol=0, atol=1e-6)
    assert np.count_nonzero(published["output__depth"]) == 779
    depth.backward(torch.from_numpy(published["input__grad_depth"]))
    for name in names:
        ours, theirs = given[name].grad.numpy(), published[f"output__grad_{name}"]
        difference = np.linalg.norm(ours - theirs) / np.linalg.norm(theirs)
        if name == "sdf" and gradient == "correct":
            cosine = np.vdot(ours, theirs) / np.linalg.norm(ours) / np.linalg.norm(theirs)
            assert cosine == pytest.approx(0.56, abs=0.01)
        else:
            assert difference < (5e-5 if name == "sdf" else 1e-5), name


def test_ball_in_closed_form():
    """Against the quadratic equation; the threshold alone keeps the ray from the surface."""
    radius, half_width, threshold = 0.6, 0.1, 1e-5
    where = place([0.03, -0.02, -0.7], [0.1, 0.5, -0.3, 0.7], half_width)
    depth = render_depth(ball(radius), where, CAMERA, threshold)
    rows, columns = torch.meshgrid(
        torch.arange(72.0, dtype=torch.float64),
        torch.arange(96.0, dtype=torch.float64),
        indexing="ij",
    )
    directions = ray_directions(CAMERA, rows, columns)
    along = directions @ where.position
    squared = (radius * half_width) ** 2 - (where.position @ where.position - along**2)
    expected = torch.where(squared > 0, along - squared.clamp(min=0).sqrt(), 0.0)
    expected = -directions[..., 2] * expected
    surely = squared.abs() > 2e-4  # the rim is interpolated
    assert torch.equal((depth > 0)[surely], (squared > 0)[surely])
    both = surely & (squared > 0)
    assert both.sum() > 100
    torch.testing.assert_close(depth[both], expected[both], rtol=0, atol=2e-4)


def test_half_space_is_exact():
    """Linear distances are interpolated exactly, and a step along the normal ends on the plane."""
    sdf = grid()[..., 2] - 0.25  # solid below z = 0.25
    where = place([0.0, 0.0, -0.5], [0.0, 0.0, 0.0, 1.0], 0.1)
    depth = render_depth(sdf, where, CAMERA, 1e-9)
    row, column = round(CAMERA.cy), round(CAMERA.cx)
    assert depth[row, column] == pytest.approx(0.5 - 0.025, abs=1e-8)
    assert depth[0, 0] == 0


@pytest.mark.parametrize("parameter", ["sdf", "position", "quaternion", "half_width"])
def test_gradient_by_finite_differences(parameter):
    """One further step of tracing along a fixed ray, differentiated by its definition."""
    random = np.random.RandomState(3)
    values = {
        "sdf": ball() + torch.from_numpy(0.02 * random.standard_normal((64, 64, 64))),
        "position": torch.tensor([0.02, 0.01, -0.6], dtype=torch.float64),
        "quaternion": torch.tensor([0.2, -0.4, 0.1, 0.8], dtype=torch.float64),
        "half_width": torch.tensor(0.12, dtype=torch.float64),
    }
    weights = torch.from_numpy(random.standard_normal(CAMERA.height * CAMERA.width))
    axes = (torch.arange(size, dtype=torch.float64) for size in (CAMERA.height, CAMERA.width))
    rows, columns = torch.meshgrid(*axes, indexing="ij")
    directions = ray_directions(CAMERA, rows.flatten(), columns.flatten())

    def put(v):
        return Placement(v["position"], rotation_matrix(v["quaternion"]), v["half_width"])

    hit, depth = ray_depths(values["sdf"], put(values), directions, 0.005)
    assert len(depth) > 200
    weights, slope = weights[hit], -directions[hit, 2]
    ends = (depth / slope)[:, None] * directions[hit]

    def depth_after_a_step(v):
        return weights @ (slope * interpolated_plainly(v["sdf"], put(v), ends))

    leaf = values[parameter].clone().requires_grad_()
    _, depth = ray_depths(
        *(lambda v: (v["sdf"], put(v)))({**values, parameter: leaf}), directions, 0.005
    )
    (weights @ depth).backward()
    for _ in range(3):
        towards = torch.from_numpy(random.standard_normal(leaf.shape))
        towards /= towards.norm()
        small = 1e-7
        ahead, behind = (
            depth_after_a_step({**values, parameter: values[parameter] + sign * small * towards})
            for sign in (1, -1)
        )
        expected = float(ahead - behind) / (2 * small)
        assert float((leaf.grad * towards).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-7)


def interpolated_plainly(sdf, where, points):
    """Trilinear interpolation written out, metres."""
    at = (points - where.position) @ where.rotation / where.half_width
    at = (at + 1) * ((len(sdf) - 1) / 2)
    base = at.detach().floor().long().clamp(0, len(sdf) - 2)
    part = at - base
    total = 0.0
    for corner in np.ndindex(2, 2, 2):
        node = base + torch.tensor(corner)
        share = torch.stack([p if c else 1 - p for p, c in zip(part.T, corner, strict=True)])
        total = total + share.prod(0) * sdf[node[:, 0], node[:, 1], node[:, 2]]
    return total * where.half_width


def test_distances_at_points():
    """As written out plainly, and 0 outside the cube."""
    random = np.random.RandomState(1)
    sdf = torch.from_numpy(random.standard_normal((64, 64, 64)))
    where = place([0.1, -0.2, -0.9], [0.5, 0.1, -0.2, 0.6], 0.15)
    points = torch.from_numpy(random.uniform(-0.3, 0.3, (500, 3))) + where.position
    inside = ((points - where.position) @ where.rotation).abs().amax(1) < 0.15
    assert 50 < inside.sum() < 450
    ours = distances(sdf, where, points)
    expected = torch.where(inside, interpolated_plainly(sdf, where, points), 0.0)
    torch.testing.assert_close(ours, expected, rtol=0, atol=1e-14)


def test_rotation_of_a_quaternion():
    quaternion = np.random.RandomState(0).standard_normal(4)
    ours = rotation_matrix(torch.from_numpy(3 * quaternion)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_quat(quaternion).as_matrix(), atol=1e-14)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ([0.0, 0.0, 0.7], 0.0),  # behind the camera
        ([5.0, 0.0, -0.7], 0.0),  # beside the image
        ([0.0, 0.0, -0.05], 0.0),  # the camera is inside the object
        ([0.0, 0.0, -0.09], 0.03),  # in the volume, before the surface
    ],
)
def test_where_nothing_is_seen(position, expected):
    where = place(position, [0.0, 0.0, 0.0, 1.0], 0.1)
    depth = render_depth(ball(), where, CAMERA, 1e-4)
    assert not torch.isnan(depth).any()
    assert depth[round(CAMERA.cy), round(CAMERA.cx)] == pytest.approx(expected, abs=1e-3)
    if not expected:
        assert not depth.any()


def test_rays_along_the_faces():
    """A direction with zeros meets no faces of two slabs: not NaN, but the right answer."""
    directions = torch.tensor([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    where = place([0.0, 0.0, -0.5], [0.0, 0.0, 0.0, 1.0], 0.1)
    hit, depth = ray_depths(ball(), where, directions, 1e-5)
    assert hit.tolist() == [True, False]
    assert depth[0] == pytest.approx(0.44, abs=1e-3)
    assert math.isfinite(depth[0])


def check_published_weights():
    """One ray's end, 0.2, 0.3 and 0.1 of a cell from a node: the weights by their list."""
    plane = 0.25 + 2 / 63 * 0.1
    sdf = (grid()[..., 2] - plane).requires_grad_()
    x, y = -1 + 2 / 63 * np.array([40.2, 25.3])
    # looking down on the plane from 5 half-widths away
    eye = torch.tensor([-x, -y, -5.0], dtype=torch.float64)
    where = Placement(
        eye, torch.eye(3, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    )
    down = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
    _, depth = ray_depths(sdf, where, down, 1e-9, "published")
    assert float(depth.detach()) == pytest.approx(5 - plane, abs=1e-6)
    depth.sum().backward()
    at = (float(5 - depth.detach()) + 1) * 31.5
    z = at - int(at)
    x, y = 0.2, 0.3
    u, v, w = 1 - x, 1 - y, 1 - z
    found = sdf.grad[40:42, 25:27, int(at) : int(at) + 2].flatten()
    named = [u * v * z, u * y * w, u * y * z, x * v * w, x * v * z, x * v * z, x * y * w, x * y * z]
    np.testing.assert_allclose(found, named, atol=1e-5)
    assert torch.count_nonzero(sdf.grad) == 8


def test_published_weights():
    check_published_weights()
