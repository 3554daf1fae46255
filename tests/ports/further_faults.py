"""More slips of a port, each planted in one of ours: where it is to be located, and how it is
explained, if it is."""

from dataclasses import replace

import numpy as np
import torch
from parity_cases import method, network
from scipy.ndimage import binary_dilation
from torch.nn import functional as F

from method_adapters import (
    _crop,
    _particle_filter,
    _prior_method,
    _sdfest_estimation,
    cass,
    rbppose,
    sdfest,
)
from method_adapters._networks import (
    asmnet as asmnet_network,
)
from method_adapters._networks import (
    cass as cass_network,
)
from method_adapters._networks import (
    crnet,
    gcn3d,
    icaps_refinement,
    pointnet2,
)
from method_adapters._networks import (
    spd as spd_network,
)

FAULTS = []


def fault(port, place, words=""):
    """Note a fault of a port, with the value where it parts and what explains it."""

    def note(plant):
        FAULTS.append((port, plant, place, words))
        return plant

    return note


def sees(patch, port, change):
    """The port sees a changed observation."""
    made = method(port)
    real = made.predict
    patch(made, "predict", lambda batch, seed: real([change(seen) for seen in batch], seed))


def _halved(depth):
    return depth.astype(np.float16).astype(np.float32)


HALF = "ones of half precision (float16)"


@fault("spd", "depth", HALF)
def depth_in_float16(patch):
    sees(patch, "spd", lambda seen: replace(seen, depth=_halved(seen.depth)))


@fault("cass", "depth", HALF)
def depth_in_float16_of_cass(patch):
    sees(patch, "cass", lambda seen: replace(seen, depth=_halved(seen.depth)))


def _dilate(patch, port):
    sees(patch, port, lambda seen: replace(seen, mask=binary_dilation(seen.mask)))


@fault("spd", "seen")
def mask_dilated(patch):
    _dilate(patch, "spd")


@fault("sdfest", "seen", "the reference's mask dilated by 1 pixel, with the neighbours beside")
def mask_dilated_of_sdfest(patch):
    _dilate(patch, "sdfest")


@fault("rbppose", "input.prior")
def prior_of_another_category(patch):
    made = method("rbppose")
    patch(made, "_priors", np.roll(made._priors, 1, axis=0))


@fault("sgpa", "input.image", "scaled along axis 0 by 1, 1, 0.982533")
def deviation_of_one_channel(patch):
    patch(_crop, "DEVIATION", np.array([0.229, 0.224, 0.229], np.float32))


@fault("cass", "input.image", "along axis 0, +0.241379, +0, -0.25 are added")
def means_of_rgb(patch):
    patch(cass, "MEAN", cass.MEAN[::-1].copy())


@fault("spd", "input.choose")
def pixels_rounded_to_the_nearest(patch):
    def index(rows, columns, crop):
        row, column = (np.rint(x * 192 / crop.width).clip(max=191) for x in (rows, columns))
        return (row * 192 + column).astype(np.int64)

    patch(_prior_method, "feature_index", index)


@fault("asmnet", "depth")
def millimetres_truncated(patch):
    patch(np, "rint", np.trunc)


@fault("spd", "network.psp.feats.layer1.0.conv1")
def padding_reflected(patch):
    patch(network("spd").psp.feats.layer1[0].conv1, "padding_mode", "reflect")


@fault("spd", "network.instance_geometry.2")
def weight_transposed(patch):
    layer = network("spd").instance_geometry[2]
    patch(layer, "forward", lambda x: F.conv1d(x, layer.weight.transpose(0, 1), layer.bias))


@fault(
    "sgpa",
    "network.instance_geometry.SA_modules.1.mlps.0.layer1.bn.bn",
    "scaled and offset along axis 1, each of 64 on its own",
)
def epsilon_of_a_norm(patch):
    path = "instance_geometry.SA_modules.1.mlps.0.layer1.bn.bn"
    patch(network("sgpa").get_submodule(path), "eps", 1e-3)


@fault("crnet", "network.transformer64.model.encoder.layers.0.sublayer.0.norm")
def branches_swapped(patch):
    real = network("crnet").transformer64.forward
    patch(network("crnet").transformer64, "forward", lambda a, b: real(b, a)[::-1])


@fault(
    "crnet",
    "network.transformer64.model.encoder.layers.0.sublayer.0.norm",
    "scaled and offset along axis 2, each of 64 on its own",
)
def biased_deviation(patch):
    def norm(self, x):
        deviation = x.std(-1, keepdim=True, unbiased=False)
        return self.a_2 * (x - x.mean(-1, keepdim=True)) / (deviation + 1e-6) + self.b_2

    patch(crnet.LayerNorm, "forward", norm)


@fault("spd", "network.psp.up_1.conv.1", "it is network.psp.up_1.conv.0 unchanged")
def early_return(patch):
    patch(network("spd").psp.up_1.conv[1], "forward", lambda x: x)


@fault("spd", "network.at_pixels")
def gather_off_by_one(patch):
    real = spd_network.at_pixels
    patch(spd_network, "at_pixels", lambda x, choose: real(x, (choose + 1) % x[0, 0].numel()))


@fault("sgpa", "network.neighbours", "+1 is added to every number")
def neighbours_off_by_one(patch):
    real = pointnet2.ball_query
    patch(pointnet2, "ball_query", lambda x, *given: (real(x, *given) + 1) % x.shape[2])


@fault("cass", "network.first_layer")
def codes_swapped(patch):
    real = cass_network.first_layer
    patch(cass_network, "first_layer", lambda layer, parts: real(layer, parts[2:] + parts[:2]))


def _features(matrix_of, pool):
    def forward(self, points):
        matrix = self.stn(points)
        x = asmnet_network.tap("network.aligned", matrix_of(matrix) @ points)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return pool(self.bn3(self.conv3(x))), matrix

    return forward


@fault(
    "asmnet",
    "network.feat.0",
    "the mean of network.feat.bn3 along axis 2, in the reference the largest",
)
def mean_for_largest(patch):
    changed = _features(lambda matrix: matrix.mT, lambda x: x.mean(-1))
    patch(asmnet_network.PointFeatures, "forward", changed)


@fault("asmnet", "network.aligned")
def transformer_transposed(patch):
    changed = _features(lambda matrix: matrix, lambda x: x.amax(-1))
    patch(asmnet_network.PointFeatures, "forward", changed)


@fault("rbppose", "network.neighbours", "shifted by [0, -1] along axes [1, 2]")
def neighbours_with_the_point_itself(patch):
    def neighbours(xyz, count):
        return gcn3d.squared_distances(xyz, xyz).topk(count, largest=False).indices

    patch(gcn3d, "neighbours", neighbours)


@fault("rbppose", "network.pooled")
def pooled_over_five(patch):
    patch(gcn3d, "POOLED", 5)


@fault("rbppose", "network.green_confidence")
def confidence_without_sigmoid(patch):
    patch(torch.Tensor, "sigmoid", lambda self: self)


@fault("rbppose", "input.mean_size")
def size_of_another_category(patch):
    sizes = rbppose.MEAN_SIZES
    patch(rbppose, "MEAN_SIZES", {**sizes, "mug": sizes["can"]})


@fault("sdfest", "input.directions", "along axis 1 the sign of [0, 2] is the other one")
def other_camera_axes(patch):
    patch(sdfest, "OPENCV_FROM_OPENGL", np.diag([-1.0, -1.0, 1.0]))


@fault("sdfest", "refined.latent")
def learning_rate(patch):
    patch(_sdfest_estimation, "LATENT_RATE", 1e-3)


@fault("sdfest", "loss")
def weight_of_a_loss(patch):
    patch(_sdfest_estimation, "POINT_WEIGHT", 1.0)


@fault("sdfest", "mesh.vertices")
def other_level(patch):
    patch(sdfest, "LEVEL", 0.05)


@fault("icaps", "input.depth")
def one_erosion(patch):
    patch(_particle_filter, "EROSIONS", 1)


@fault("icaps", "radii")
def other_quantile(patch):
    patch(_particle_filter, "INSIDE", 0.9)


@fault("icaps", "latent_net.cls_layer.1", "and the others 2 times those: dropout is on")
def dropout_left_on(patch):
    torch.manual_seed(0)
    patch(method("icaps")._networks["mug"][1]._latent_net.cls_layer[1], "training", True)


@fault("icaps", "distances", "the reference's axes in the order [2, 1, 0]")
def axes_of_the_volume(patch):
    real = icaps_refinement.distance_grid
    patch(icaps_refinement, "distance_grid", lambda shape: real(shape).transpose(2, 1, 0))
