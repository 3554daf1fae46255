"""Cascaded Relation Network: Wang, Chen & Dou, "Category-Level 6D Object Pose Estimation via
Cascaded Relation and Recurrent Reconstruction Networks", IROS 2021."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from method_adapters._networks.attention import MultiHeadAttention
from method_adapters._networks.heads import CategoryMlp, Deformed, at_pixels, pointwise
from method_adapters._networks.pspnet import PSPNet
from pytest_cpas.adapting import tap

PRIOR_POINTS = 1024
HEADS = 4
FEED_FORWARD = 1024


class LayerNorm(nn.Module):
    """Normalised by the unbiased standard deviation, to which epsilon is added."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.a_2 = nn.Parameter(torch.ones(width))
        self.b_2 = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) to (..., C)."""
        deviation, mean = torch.std_mean(x, -1, keepdim=True)
        return self.a_2 * (x - mean) / (deviation + 1e-6) + self.b_2


class FeedForward(nn.Module):
    """Two linear layers with a ReLU between."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.w_1 = nn.Linear(width, FEED_FORWARD)
        self.w_2 = nn.Linear(FEED_FORWARD, width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, C) to (B, N, C)."""
        y: Tensor = self.w_2(torch.relu(self.w_1(x)))
        return y


class PreNorm(nn.Module):
    """The norm that goes before a sublayer, under the published name."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, C) to (B, N, C)."""
        y: Tensor = self.norm(x)
        return y


class EncoderLayer(nn.Module):
    """Self-attention and feed-forward, each behind a norm and added to its input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.self_attn = MultiHeadAttention(width, HEADS)
        self.feed_forward = FeedForward(width)
        self.sublayer = nn.ModuleList(PreNorm(width) for _ in range(2))

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, C) to (B, N, C)."""
        y = self.sublayer[0](x)
        x = x + self.self_attn(y, y, y)
        x = x + self.feed_forward(self.sublayer[1](x))
        return x


class DecoderLayer(nn.Module):
    """The same with attention to the encoded other branch in between."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.self_attn = MultiHeadAttention(width, HEADS)
        self.src_attn = MultiHeadAttention(width, HEADS)
        self.feed_forward = FeedForward(width)
        self.sublayer = nn.ModuleList(PreNorm(width) for _ in range(3))

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """(B, N, C) and (B, M, C) to (B, N, C)."""
        y = self.sublayer[0](x)
        x = x + self.self_attn(y, y, y)
        x = x + self.src_attn(self.sublayer[1](x), memory, memory)
        x = x + self.feed_forward(self.sublayer[2](x))
        return x


class Encoder(nn.Module):
    """One layer and a final norm."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([EncoderLayer(width)])
        self.norm = LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, N, C) to (B, N, C)."""
        y: Tensor = self.norm(self.layers[0](x))
        return y


class Decoder(nn.Module):
    """One layer and a final norm."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList([DecoderLayer(width)])
        self.norm = LayerNorm(width)

    def forward(self, x: Tensor, memory: Tensor) -> Tensor:
        """(B, N, C) and (B, M, C) to (B, N, C)."""
        y: Tensor = self.norm(self.layers[0](x, memory))
        return y


class EncoderDecoder(nn.Module):
    """What one branch makes of the other."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.encoder, self.decoder = Encoder(width), Decoder(width)

    def forward(self, source: Tensor, target: Tensor) -> Tensor:
        """(B, N, C) and (B, M, C) to the update of the target (B, M, C)."""
        y: Tensor = self.decoder(target, self.encoder(source))
        return y


class Relation(nn.Module):
    """The relation of two branches, in both directions with the same weights."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.model = EncoderDecoder(width)

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
        """(B, C, N) and (B, C, M) to their updates, of the same shapes."""
        a, b = a.mT, b.mT
        return self.model(b, a).mT, self.model(a, b).mT


class CrNet(nn.Module):
    """SPD's branches, related to each other twice; the shape refined over three stages.

    The second and third stage set features of observed points beside those of prior points, so
    there must be as many of the one as of the other.
    """

    def __init__(self) -> None:
        super().__init__()
        self.psp = PSPNet()
        self.instance_color = pointwise(32, 64)
        self.instance_geometry = pointwise(3, 64, 64, 64)
        self.instance_global = pointwise(128, 128)
        self.transformer64, self.transformer128 = Relation(64), Relation(128)
        for stage, width in (("", 128), ("0", 256), ("1", 384)):
            setattr(self, f"category_local{stage}", pointwise(3, 64, 64, 64))
            setattr(self, f"category_global{stage}", pointwise(64, 128))
            setattr(self, f"assignment{stage}", CategoryMlp(width, 512, 256, PRIOR_POINTS))
            setattr(self, f"deformation{stage}", CategoryMlp(width, 512, 256, 3))

    def forward(
        self, points: Tensor, image: Tensor, choose: Tensor, category: Tensor, prior: Tensor
    ) -> Deformed:
        """As :meth:`method_adapters._networks.spd.SpdNet.forward`, N = M; ``assign`` is a product
        of three matrices."""
        colour = self.instance_color(at_pixels(self.psp(image), choose))
        geometry = self.instance_geometry(points.mT)
        geometry_update, colour_update = self.transformer64(geometry, colour)
        instance = torch.cat([geometry + geometry_update, colour + colour_update], 1)
        instance = self.instance_global(instance)
        shape = self._encoded("", prior)
        instance_update, shape_update = self.transformer128(instance, shape)
        instance, shape = instance + instance_update, shape + shape_update
        assign, deltas = self._stage("", instance, shape, category)
        for stage in ("0", "1"):
            encoded = self._encoded(stage, tap("network.deformed", prior + deltas))
            instance, shape = torch.cat([encoded, instance], 1), torch.cat([encoded, shape], 1)
            more_assign, more_deltas = self._stage(stage, instance, shape, category)
            assign, deltas = assign @ more_assign, deltas + more_deltas
        return Deformed(assign, deltas)

    def _encoded(self, stage: str, shape: Tensor) -> Tensor:
        local = getattr(self, f"category_local{stage}")(shape.mT)
        encoded: Tensor = getattr(self, f"category_global{stage}")(local)
        return encoded

    def _stage(self, stage: str, instance: Tensor, shape: Tensor, category: Tensor) -> Deformed:
        assignment: CategoryMlp = getattr(self, f"assignment{stage}")
        deformation: CategoryMlp = getattr(self, f"deformation{stage}")
        return Deformed(
            assignment.of(instance, category=category).mT,
            deformation.of(shape, category=category).mT,
        )
