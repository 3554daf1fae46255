"""Faults that a port of SDFEst has: each must be found."""

import numpy as np
import pytest
import sdfest_cases as own
import test_port_sdf_renderer as renderer_tests
import test_port_sdfest as tests
import test_port_sdfest_networks as network_tests
import test_port_so3_grid as grid_tests
import torch
from torch.nn import functional

from method_adapters import _sdf_renderer, _sdfest_estimation, _so3_grid, sdfest
from method_adapters._networks import sdfest as networks


def check_shape():
    """Metric, and where the level is."""
    mesh = sdfest.reconstruct(
        own.Ellipsoids(),
        _sdfest_estimation.Estimate(
            torch.zeros(3), torch.zeros(3), torch.ones(4) / 2, torch.tensor(own.HALF_WIDTH)
        ),
    )
    expected = 2 * own.HALF_WIDTH * (own.HALF_AXES + 0.02)
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), expected, rtol=5e-3)


def check_cells():
    grid_tests.test_published_cells(
        301, [0.905061191828, 0.105662432703, 0.394337567297, -0.119153566374]
    )


def check_object_axes():
    """Up is up in the answer, whatever it is in the network."""
    estimate = _sdfest_estimation.Estimate(
        torch.zeros(3), torch.zeros(3), torch.tensor([0.0, 0, 0, 1]), torch.tensor(0.1)
    )
    model = own.method()._models["mug"]
    mesh = sdfest.reconstruct(model.vae, estimate)
    found = sdfest.interpret(estimate, mesh, model.axes, 0)
    # the longest axis, the network's z
    assert np.ptp(found.mesh.vertices, axis=0).argmax() == 1
    np.testing.assert_allclose(found.rotation @ [0, 1, 0], [0, 0, 1], atol=1e-6)
    placed = found.rotation @ found.mesh.vertices.T
    np.testing.assert_allclose(placed.T, mesh.vertices, atol=1e-6)


# -- networks ---------------------------------------------------------------------------------


def decoder_corners_aligned(patch):
    def fault(old, new, *like):
        nodes = torch.eye(old)[None]
        along = functional.interpolate(nodes, size=new, mode="linear", align_corners=True)[0].T
        return along.to(*reversed(like))

    patch(networks, "_interpolation", fault)


def kernel_planes_backwards(patch):
    real = networks._Convolution.forward
    patch(networks._Convolution, "forward", lambda self, x: real(self, x.flip(2)).flip(2))


def batch_norm_in_training_mode(patch):
    made = own.networks

    def fault(name):
        return tuple(network.train() for network in made.__wrapped__(name))

    patch(own, "networks", fault)


def mean_instead_of_maximum(patch):
    patch(torch.Tensor, "amax", lambda x, *args, **kwargs: x.mean(*args, **kwargs))


def residual_left_out(patch):
    real = networks._PointNet.__init__

    def fault(self, layers):
        real(self, layers)
        self._residual = False

    patch(networks._PointNet, "__init__", fault)


# -- first estimate ---------------------------------------------------------------------------


def mean_not_taken_off(patch):
    patch(torch.Tensor, "mean", lambda x, *args: torch.zeros_like(x[0]))


def points_in_opencv_axes(patch):
    patch(sdfest, "OPENCV_FROM_OPENGL", np.eye(3))


def background_kept(patch):
    patch(sdfest, "FAR", 3.0)


def directions_slow(patch):
    real = _so3_grid.rotation_grid

    def fault(resolution):
        return real(resolution).reshape(12, 48, 4).transpose(1, 0, 2).reshape(-1, 4)

    patch(grid_tests, "rotation_grid", fault)


def cells_in_ring_order(patch):
    def fault(side, real=_so3_grid.healpix_centres):
        theta, phi = real(side)
        order = np.lexsort((phi, theta))
        return theta[order], phi[order]

    patch(_so3_grid, "healpix_centres", fault)


def scalar_first(patch):
    real = _so3_grid.rotation_grid
    patch(grid_tests, "rotation_grid", lambda resolution: np.roll(real(resolution), 1, axis=1))


# -- renderer and refinement ------------------------------------------------------------------


def object_to_camera_inverted(patch):
    real = _sdf_renderer.rotation_matrix
    patch(_sdfest_estimation, "rotation_matrix", lambda q: real(q).T)


def threshold_in_metres(patch):
    real = _sdfest_estimation.ray_depths
    patch(
        _sdfest_estimation,
        "ray_depths",
        lambda sdf, place, directions, threshold, gradient: real(
            sdf, place, directions, threshold / 0.6, gradient
        ),
    )


def corners_not_aligned(patch):
    def fault(sdf, at):
        grid = at.flip(-1)[:, None, None]
        found = functional.grid_sample(
            sdf[:, None], grid, padding_mode="border", align_corners=False
        )
        return found[:, 0, 0, 0]

    patch(_sdf_renderer, "interpolated", fault)


def axes_reversed(patch):
    real = _sdf_renderer.interpolated
    patch(_sdf_renderer, "interpolated", lambda sdf, at: real(sdf, at.flip(-1)))


def points_outside_counted(patch):
    def fault(sdf, place, points):
        at = _sdf_renderer.in_cube(place, points)
        return _sdf_renderer.interpolated(sdf[None], at[None])[0] * place.half_width

    patch(renderer_tests, "distances", fault)


def weights_of_the_losses_exchanged(patch):
    patch(_sdfest_estimation, "DEPTH_WEIGHT", 3.0)
    patch(_sdfest_estimation, "POINT_WEIGHT", 1.0)


def rates_exchanged(patch):
    patch(_sdfest_estimation, "POSITION_RATE", 1e-2)
    patch(_sdfest_estimation, "LATENT_RATE", 1e-3)


def weights_in_the_right_order(patch):
    real = _sdf_renderer.ray_depths
    patch(
        renderer_tests,
        "ray_depths",
        lambda sdf, place, directions, threshold, gradient="correct": real(
            sdf, place, directions, threshold, "correct"
        ),
    )


# -- answer -----------------------------------------------------------------------------------


def surface_at_zero(patch):
    patch(sdfest, "LEVEL", 0.0)


def half_width_for_the_width(patch):
    real = sdfest.level_set
    patch(
        sdfest,
        "level_set",
        lambda values, level, half_width, closed: real(
            values, level, half_width=half_width / 2, closed=closed
        ),
    )


def nodes_at_the_middle_of_voxels(patch):
    real = sdfest.level_set
    patch(
        sdfest,
        "level_set",
        lambda values, level, half_width, closed: real(
            values, level, half_width=half_width * 31 / 32, closed=closed
        ),
    )


def axes_not_turned(patch):
    real = sdfest.interpret
    patch(sdfest, "interpret", lambda found, mesh, axes, seed: real(found, mesh, np.eye(3), seed))


@pytest.mark.parametrize(
    ("check", "plant"),
    [
        (own.check_networks, decoder_corners_aligned),
        (own.check_networks, kernel_planes_backwards),
        (own.check_networks, batch_norm_in_training_mode),
        (own.check_networks, mean_instead_of_maximum),
        (network_tests.test_point_network_written_out, residual_left_out),
        (tests.check_first_estimate, mean_not_taken_off),
        (tests.check_view, points_in_opencv_axes),
        (tests.check_far_pixels, background_kept),
        (check_cells, directions_slow),
        (check_cells, cells_in_ring_order),
        (check_cells, scalar_first),
        (tests.check_steps, object_to_camera_inverted),
        (tests.check_steps, threshold_in_metres),
        (tests.check_steps, corners_not_aligned),
        (tests.check_steps, axes_reversed),
        (renderer_tests.test_distances_at_points, points_outside_counted),
        (tests.check_steps, weights_of_the_losses_exchanged),
        (tests.check_steps, rates_exchanged),
        (renderer_tests.check_published_weights, weights_in_the_right_order),
        (check_shape, surface_at_zero),
        (check_shape, half_width_for_the_width),
        (check_shape, nodes_at_the_middle_of_voxels),
        (check_object_axes, axes_not_turned),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_planted_fault_is_found(monkeypatch, check, plant):
    own.networks("released"), own.networks("older")  # made before anything is broken
    check()
    plant(monkeypatch.setattr)
    with pytest.raises(AssertionError):
        check()
