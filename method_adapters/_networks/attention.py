"""Multi-head attention (Vaswani et al., NeurIPS 2017) with the parameter names of SGPA and
CR-Net."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional as F


class MultiHeadAttention(nn.Module):
    """Four linear layers: query, key, value, output."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.linears = nn.ModuleList(nn.Linear(width, width) for _ in range(4))

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """(B, N, C), (B, M, C) and (B, M, C) to (B, N, C)."""
        split = [
            linear(x).unflatten(2, (self.heads, -1)).transpose(1, 2)
            for linear, x in zip(self.linears, (query, key, value), strict=False)
        ]
        attended = F.scaled_dot_product_attention(*split)
        y: Tensor = self.linears[3](attended.transpose(1, 2).flatten(2))
        return y
