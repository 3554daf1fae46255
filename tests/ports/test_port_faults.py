"""Faults that ports have: each must be found by the comparison with recorded outputs."""

import copy
from dataclasses import replace

import cases
import numpy as np
import pytest
import test_port_preparation
import torch

from method_adapters import _prior_method
from method_adapters._crop import NoAnswerError, crop_of, network_image
from method_adapters._networks import attention, crnet, heads, pointnet2, pspnet
from method_adapters._networks.heads import assigned
from method_adapters._prior_method import pose_from_coordinates
from method_adapters.dpdn import Dpdn
from pytest_cpas.types import CATEGORIES

#: All of them together.
pytestmark = pytest.mark.minutes


def align_corners_flipped(patch):
    real = pspnet._resized
    patch(pspnet, "_resized", lambda x, size, align_corners: real(x, size, not align_corners))


def batch_norm_in_training_mode(patch):
    real = cases.network
    patch(cases, "network", lambda name: copy.deepcopy(real(name)).train())


def softmax_over_the_structure_points(patch):
    def fault(name, real=cases.network):
        network = copy.deepcopy(real(name))
        network.conv1d_stpts_prob[-1].dim = 1
        return network

    patch(cases, "network", fault)


def last_neighbours_instead_of_first(patch):
    real = pointnet2.ball_query

    def fault(distances, radius, count):
        return distances.shape[-1] - 1 - real(distances.flip(-1), radius, count)

    patch(pointnet2, "ball_query", fault)


def interpolation_by_squared_distance(patch):
    real = pointnet2.interpolate
    patch(
        pointnet2,
        "interpolate",
        lambda features, squared, index: real(features, squared.square(), index),
    )


def parts_concatenated_backwards(patch):
    real = torch.cat
    patch(torch, "cat", lambda parts, dim: real(list(parts)[::-1], dim))


def next_category(patch):
    real = heads.PerCategory.of
    patch(heads.PerCategory, "of", lambda self, x, category: real(self, x, (category + 1) % 6))


def maximum_instead_of_mean(patch):
    patch(torch.nn.AdaptiveAvgPool1d, "forward", lambda self, x: x.amax(2, keepdim=True))


def refinement_without_the_prior(patch):
    real = crnet.CrNet._encoded
    priors = []

    def fault(self, stage, shape):
        priors.append(shape)
        return real(self, stage, shape - priors[0] if stage else shape)

    patch(crnet.CrNet, "_encoded", fault)


def biased_deviation(patch):
    real = torch.std_mean
    patch(torch, "std_mean", lambda x, dim, keepdim: real(x, dim, correction=0, keepdim=keepdim))


def one_attention_head(patch):
    real = attention.MultiHeadAttention.forward

    def fault(self, query, key, value):
        heads_, self.heads = self.heads, 1
        y = real(self, query, key, value)
        self.heads = heads_
        return y

    patch(attention.MultiHeadAttention, "forward", fault)


def near_points_sampled(patch):
    real = pointnet2.farthest_points
    patch(
        pointnet2,
        "farthest_points",
        lambda xyz, count, max_threads, skip_radius_squared: real(
            xyz, count, max_threads=max_threads
        ),
    )


def crop_off_by_one(patch):
    def fault(mask):
        crop = crop_of(mask)
        return replace(crop, row=crop.row - 1)

    patch(_prior_method, "crop_of", fault)


def blue_first(patch):
    patch(_prior_method, "network_image", lambda rgb, crop: network_image(rgb[..., ::-1], crop))


def pixels_rounded(patch):
    def fault(rows, columns, crop):
        ratio = 192 / crop.width
        return (np.rint(rows * ratio) * 192 + np.rint(columns * ratio)).astype(np.int64)

    patch(_prior_method, "feature_index", fault)


def holes_left_in_the_depth(patch):
    patch(Dpdn, "depth_of", lambda self, observation: observation.depth)


@pytest.mark.parametrize(
    ("check", "name", "plant"),
    [
        (cases.check_network, "spd", align_corners_flipped),
        (cases.check_network, "dpdn", align_corners_flipped),
        (cases.check_network, "sgpa", batch_norm_in_training_mode),
        (cases.check_network, "dpdn", batch_norm_in_training_mode),
        (cases.check_network, "sgpa", softmax_over_the_structure_points),
        (cases.check_network, "sgpa", last_neighbours_instead_of_first),
        (cases.check_network, "sgpa", interpolation_by_squared_distance),
        (cases.check_network, "spd", parts_concatenated_backwards),
        (cases.check_network, "crnet", next_category),
        (cases.check_network, "spd", maximum_instead_of_mean),
        (cases.check_network, "crnet", refinement_without_the_prior),
        (cases.check_network, "crnet", biased_deviation),
        (cases.check_network, "crnet", one_attention_head),
        (cases.check_network, "dpdn", near_points_sampled),
        (cases.check_inputs, "spd", crop_off_by_one),
        (cases.check_inputs, "spd", blue_first),
        (cases.check_inputs, "dpdn", pixels_rounded),
        (cases.check_inputs, "dpdn", holes_left_in_the_depth),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_planted_fault_is_found(monkeypatch, check, name, plant):
    cases.network(name)  # made before anything is broken
    plant(monkeypatch.setattr)
    with pytest.raises((AssertionError, RuntimeError)) as caught:
        check(name)
    # shapes that no longer fit are found as well, but only where parts change places
    assert caught.type is AssertionError or plant is parts_concatenated_backwards


def prior_not_added(inputs, *given):
    return pose_from_coordinates(inputs._replace(prior=np.zeros_like(inputs.prior)), *given)


@pytest.mark.parametrize(
    ("module", "name", "fault", "category"),
    [
        (test_port_preparation, "pose_from_coordinates", prior_not_added, "bottle"),
        (test_port_preparation, "pose_from_coordinates", prior_not_added, "mug"),
        (
            test_port_preparation,
            "assigned",
            lambda assign, prior, deltas: assigned(assign, 0 * prior, deltas),
            "mug",
        ),
        (
            test_port_preparation,
            "assigned",
            lambda assign, prior, deltas: assigned(assign.mT, prior, deltas),
            "bottle",
        ),
        (_prior_method, "MUG_OFFSET", 0.0, "mug"),
    ],
    ids=["prior", "prior of a mug", "prior assigned", "transposed", "not recentred"],
)
def test_planted_fault_in_the_pose_is_found(monkeypatch, module, name, fault, category):
    monkeypatch.setattr(module, name, fault)
    with pytest.raises((AssertionError, NoAnswerError)):
        test_port_preparation.test_pose_from_a_known_assignment(CATEGORIES.index(category))
