"""Channels of random networks set so that observed points are assigned to points of the prior as
coordinates around their middle would have it; for plausible.py.

A coordinate takes two channels, its positive and its negative part, so that a ReLU leaves it alone.
"""

import numpy as np
import torch

from method_adapters.rbppose import MEAN_SIZES
from pytest_cpas.types import CATEGORIES

State = dict[str, torch.Tensor]

#: The channels of x, y and z.
SIX = np.arange(6)
#: From coordinates to their parts; from parts to coordinates and to their parts again.
PARTS = np.kron(np.eye(3), [[1], [-1]])
AGAIN = PARTS @ PARTS.T
#: Of what a last layer says besides; CR-Net multiplies three of them.
NOISE = {"spd": 1.0, "sgpa": 0.1, "crnet": 0.002}
#: Camera axes to those of an upright object that faces the camera.
UPRIGHT = np.diag([1.0, -1.0, -1.0])


def wire(
    state: State,
    layer: str,
    rows: np.ndarray,
    columns: np.ndarray,
    matrix: np.ndarray | None = None,
) -> None:
    """Let channels ``rows`` of a linear layer or 1x1 convolution be ``matrix``, or the identity,
    times its input channels ``columns``, and nothing else."""
    silence(state, layer, rows)
    flat = state[f"{layer}.weight"].flatten(1)
    values = np.eye(len(rows)) if matrix is None else matrix
    flat[np.ix_(rows, columns)] = torch.from_numpy(values.astype(np.float32))


def silence(state: State, layer: str, rows: np.ndarray) -> None:
    state[f"{layer}.weight"][rows] = 0
    if f"{layer}.bias" in state:
        state[f"{layer}.bias"][rows] = 0


def gain(state: State, norm: str, rows: np.ndarray, value: float) -> None:
    """Of CR-Net's layer norms."""
    state[f"{norm}.a_2"][rows] = value
    state[f"{norm}.b_2"][rows] = 0


def wire_all(state: State, *layers: str) -> None:
    """Let the first channels of these layers be what they get."""
    for layer in layers:
        wire(state, layer, SIX, SIX)


def logits(prior: np.ndarray, category: int) -> np.ndarray:
    """What the points (M, 3) of a prior have to be multiplied with, so that the softmax over them
    takes a point of an object of average size to its place on the prior; per metre."""
    middle = (prior.min(axis=0) + prior.max(axis=0)) / 2
    half = np.ptp(prior, axis=0) / 2
    diagonal = np.linalg.norm(MEAN_SIZES[CATEGORIES[category]])
    # to first order, the softmax's derivative is the variance: over the surface of an ellipsoid a
    # third of the half axis squared
    return 3 * (prior - middle) / half**2 / diagonal


def assign(state: State, layer: str, directions: np.ndarray, noise: float) -> None:
    """A last layer per category that says the products of ``directions`` (6, M, 3) with the
    coordinates, and little else."""
    state[f"{layer}.weight"] *= noise
    state[f"{layer}.bias"] *= noise
    flat = state[f"{layer}.weight"].flatten(1)
    values = directions.reshape(-1, 3) @ PARTS.T
    flat[:, SIX] = torch.from_numpy(values.astype(np.float32))


def to_prior(priors: np.ndarray) -> np.ndarray:
    """For all categories, (6, M, 3); see :func:`logits`."""
    return np.stack([logits(prior, i) for i, prior in enumerate(priors)])


def spd(state: State, priors: np.ndarray) -> None:
    """The global feature has the coordinates' mean."""
    wire(state, "instance_geometry.0", SIX, np.arange(3), PARTS)
    wire_all(state, "instance_geometry.2", "instance_geometry.4")
    wire_all(state, "instance_global.0", "instance_global.2")
    columns = np.concatenate([SIX, 128 + SIX])
    wire(state, "assignment.0", SIX, columns, np.concatenate([AGAIN, -AGAIN], 1))
    wire_all(state, "assignment.2")
    assign(state, "assignment.4", to_prior(priors) @ UPRIGHT, NOISE["spd"])


def wire_encoder(state: State, encoder: str, norm: str, behind: int) -> None:
    """PointNet++ sees no coordinates, but how far the farthest points of the coarsest groups are in
    each direction; ``behind``: features of the smaller radius, which come first."""
    path = [f"SA_modules.3.mlps.1.layer{i}" for i in range(3)]
    path += [f"FP_modules.{level}.mlp.layer{i}" for level in (3, 2, 1, 0) for i in range(2)]
    for i, layer in enumerate(path):
        if i == 0:
            wire(state, f"{encoder}.{layer}.conv", SIX, np.arange(3), PARTS)
        else:
            wire(state, f"{encoder}.{layer}.conv", SIX, SIX + behind if i == 3 else SIX)
        for part, value in (("weight", 1), ("bias", 0), ("running_mean", 0), ("running_var", 1)):
            state[f"{encoder}.{layer}.{norm}.bn.{part}"][SIX] = value


def sgpa(state: State, priors: np.ndarray) -> None:
    """A coordinate is half the difference of what the encoder sees below it and above it."""
    wire_encoder(state, "instance_geometry", "bn", 512)
    wire(state, "assignment.0", SIX, SIX, -AGAIN / 2)
    wire_all(state, "assignment.2")
    assign(state, "assignment.4", to_prior(priors) @ UPRIGHT, NOISE["sgpa"])


def dpdn(state: State) -> None:
    """The same for the points of the prior."""
    wire_encoder(state, "prior_extractor", "normlayer", 256)
    deformer = "posenet.deformer"
    silence(state, f"{deformer}.deform_mlp1.7", SIX)
    wire_all(state, f"{deformer}.deform_mlp2.0", f"{deformer}.deform_mlp2.2")
    state[f"{deformer}.deform_mlp2.4.weight"][:, SIX, 0] = torch.from_numpy(
        np.tile(-PARTS.T / 2, (6, 1)).astype(np.float32)
    )


def cass(state: State, shape: np.ndarray) -> None:
    """The grid has the shape in its last columns, and both folds leave it alone."""
    folding = "foldingnet.reconstructing"
    state[f"{folding}.grid_buf"][:, 6:] = torch.from_numpy(shape.astype(np.float32))
    for fold, columns in (("Fold1", np.arange(6, 9)), ("Fold2", np.arange(3))):
        wire(state, f"{folding}.{fold}.mlp.0", SIX, columns, PARTS)
        wire(state, f"{folding}.{fold}.mlp.2", SIX, SIX)
        state[f"{folding}.{fold}.mlp.4.weight"][:, SIX] = torch.from_numpy(
            PARTS.T.astype(np.float32)
        )


def crnet(state: State, priors: np.ndarray) -> None:
    """A head of the attention of the points to each other takes the mean of the coordinates."""
    means, constant, large = 6 + SIX, np.array([12]), 100.0
    wire(state, "instance_geometry.0", SIX, np.arange(3), PARTS)
    wire_all(state, "instance_geometry.2", "instance_geometry.4")
    silence(state, "instance_geometry.4", np.concatenate([means, constant]))
    # beside it, layer norms change the rest by one factor
    state["instance_geometry.4.bias"][constant] = large
    spread = large / 8  # of one among 64 channels
    model = "transformer64.model.decoder"
    layer = f"{model}.layers.0"
    gain(state, f"{layer}.sublayer.0.norm", SIX, 1)
    silence(state, f"{layer}.self_attn.linears.0", np.arange(16))  # a query that all keys fit
    wire(state, f"{layer}.self_attn.linears.2", SIX, SIX)
    for output in ("self_attn.linears.3", "src_attn.linears.3", "feed_forward.w_2"):
        silence(state, f"{layer}.{output}", np.arange(13))
    wire(state, f"{layer}.self_attn.linears.3", means, SIX)
    gain(state, f"{model}.norm", np.arange(13), 0)
    gain(state, f"{model}.norm", means, spread**2)
    # to the other branch they mean nothing
    state["instance_global.0.weight"][:, [12, *(64 + means)]] = 0
    columns = np.concatenate([SIX, means])
    wire(state, "instance_global.0", SIX, columns, np.concatenate([AGAIN, -AGAIN], 1))
    gain(state, "transformer128.model.decoder.norm", SIX, 0)
    # the three assignments are multiplied: to a point's dual, from it to another's, to the logit
    moments = np.einsum("cmi,cmj->cij", priors, priors)
    dual = np.linalg.solve(moments, priors.transpose(0, 2, 1)).transpose(0, 2, 1)
    for stage, directions in (("", dual @ UPRIGHT), ("0", dual), ("1", to_prior(priors))):
        wire(state, f"category_local{stage}.0", SIX, np.arange(3), PARTS)
        wire_all(state, f"category_local{stage}.2", f"category_local{stage}.4")
        wire_all(state, f"category_global{stage}.0")
        wire_all(state, f"assignment{stage}.0", f"assignment{stage}.2")
        assign(state, f"assignment{stage}.4", directions, NOISE["crnet"])


def sdfest(decoder: State) -> None:
    """A channel of the coarsest grid holds the distances from an ellipsoid's centre, and all layers
    leave it alone."""
    node = np.arange(8) - 3.5
    # of what convolutions without padding leave of the grid, the half-width, in its cells
    grid = np.stack(np.meshgrid(node, node, node, indexing="ij"), -1) / 2.42
    distances = np.linalg.norm(grid / [0.5, 0.8, 0.65], axis=-1).ravel().round(6)
    cells = np.arange(len(distances))
    silence(decoder, "decoder._fc_layers.2", cells)
    decoder["decoder._fc_layers.2.bias"][cells] = torch.from_numpy(distances.astype(np.float32))
    for i in range(3):
        silence(decoder, f"decoder._conv_layers.{i}", np.array([0]))
        decoder[f"decoder._conv_layers.{i}.weight"][0, 0, 1, 1, 1] = 1
    # about the slope of a distance
    decoder["decoder._conv_layers.3.weight"][0, 0] = 0.65
    decoder["decoder._conv_layers.3.bias"][0] = -0.65
