"""The layers of SDFEst's networks: those of the release v0.1.0, or as a published file says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from method_adapters._assets import AssetError
from pytest_cpas.adapting import ContractError, read_yaml


@dataclass(frozen=True)
class PointNetLayers:
    """The point network: layer ``widths``; ``dense``: every layer but the last also hands on the
    maximum over the points; ``residual``: a layer's input is added where the widths agree."""

    widths: Sequence[int] = (128, 128, 128, 128, 1024)
    dense: bool = True
    residual: bool = True
    batch_norm: bool = True


@dataclass(frozen=True)
class HeadLayers:
    """The head: layer ``widths``, and the ``resolution`` of its grid of rotations."""

    widths: Sequence[int] = (512, 256, 128)
    resolution: int = 1
    batch_norm: bool = True


@dataclass(frozen=True)
class EncoderLayer:
    """A convolution of the encoder, followed by ReLU."""

    in_channels: int
    out_channels: int
    kernel_size: int
    stride: int


@dataclass(frozen=True)
class DecoderLayer:
    """A convolution of the decoder: its input is resized to ``in_size`` nodes along each axis;
    ``relu``: ReLU follows."""

    in_size: int
    in_channels: int
    out_channels: int
    kernel_size: int
    relu: bool


@dataclass(frozen=True)
class Configuration:
    """What is needed to build both networks, and to read what they say.

    ``weights``: names of the files of the initialisation network and of the auto-encoder.
    ``linear``: widths of the decoder's fully connected layers. ``z_up``: the object frame is not
    ShapeNet's, but has y and z exchanged.
    """

    weights: tuple[str, str]
    z_up: bool = False
    latent: int = 8
    point_net: PointNetLayers = PointNetLayers()
    head: HeadLayers = HeadLayers()
    encoder: Sequence[EncoderLayer] = (
        EncoderLayer(1, 4, 3, 2),
        EncoderLayer(4, 8, 3, 2),
        EncoderLayer(8, 16, 3, 2),
    )
    linear: Sequence[int] = (20, 50, 8192)
    decoder: Sequence[DecoderLayer] = (
        DecoderLayer(8, 16, 16, 3, True),
        DecoderLayer(16, 16, 8, 3, True),
        DecoderLayer(32, 8, 4, 3, True),
        DecoderLayer(64, 4, 1, 1, False),
    )


def released(category: str) -> Configuration:
    """The configuration of the release v0.1.0, which comes without a file that says it."""
    return Configuration((f"{category}_init.pt", f"{category}_vae.pt"))


def read_configuration(path: Path) -> Configuration:
    """A published configuration file (YAML) of one category.

    What it says about training is left aside. Raises :class:`AssetError` for a file that is none,
    or that asks for something that is not built here.
    """
    try:
        content = read_yaml(path)
    except ContractError as error:
        raise AssetError(f"{error}; it is not a configuration of SDFEst as published") from error
    try:
        vae, init = content["vae"], content["init"]
        backbone, head = init["backbone"], init["head"]
        built = {
            "init.backbone_type": (init["backbone_type"], "VanillaPointNet"),
            "init.head_type": (init["head_type"], "SDFPoseHead"),
            "init.normalize_pose": (init["normalize_pose"], True),
            "init.backbone.in_size": (backbone["in_size"], 3),
            "init.head.orientation_repr": (head["orientation_repr"], "discretized"),
            "vae.tsdf": (vae.get("tsdf", False), False),
        }
        configuration = Configuration(
            weights=(Path(init["model"]).name, Path(vae["model"]).name),
            # networks trained before October 2021, when that changed, have one data set
            z_up="generated_dataset" in init,
            latent=vae["latent_size"],
            point_net=PointNetLayers(
                backbone["mlp_out_sizes"],
                backbone.get("dense", False),
                backbone.get("residual", False),
                backbone["batchnorm"],
            ),
            head=HeadLayers(
                head["mlp_out_sizes"], head["orientation_grid_resolution"], head["batchnorm"]
            ),
            encoder=_encoder(vae["encoder"]["layer_infos"]),
            linear=[layer["out"] for layer in vae["decoder"]["fc_layers"]],
            decoder=[DecoderLayer(**layer) for layer in vae["decoder"]["conv_layers"]],
        )
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise AssetError(
            f"{path}: it is not a configuration of SDFEst as published: {type(error).__name__}"
            f" {error}"
        ) from error
    for key, (seen, expected) in built.items():
        if seen != expected:
            raise AssetError(f"{path}: {key} is {seen!r}; only {expected!r} is built")
    return configuration


def _encoder(layers: Sequence[dict[str, Any]]) -> list[EncoderLayer]:
    """The convolutions, if ReLU follows each of them and one Flatten all."""
    names = [layer["type"].removeprefix("torch.nn.") for layer in layers]
    convolutions = [EncoderLayer(**layer["args"]) for layer in layers if layer["args"]]
    if names != ["Conv3d", "ReLU"] * len(convolutions) + ["Flatten"]:
        raise TypeError(f"vae.encoder.layer_infos are {names}; convolutions with ReLU are built")
    return convolutions
