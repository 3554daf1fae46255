"""Seeded random weights: a pure function of seed, parameter name, shape and type."""

import hashlib
import zlib

import numpy as np
import pytest

# this module is imported before torch is: whatever needs it is skipped
torch = pytest.importorskip("torch", reason="no torch: pip install 'pytest-cpas[torch]'")


def value(key: str, shape: tuple[int, ...], floating: bool, seed: int) -> torch.Tensor:
    key = key.removeprefix("module.")
    if not floating:
        return torch.zeros(shape, dtype=torch.int64)
    n = int(np.prod(shape))
    generator = np.random.RandomState((seed * 1000003 + zlib.crc32(key.encode())) % 2**32)
    if key.endswith("running_var"):
        values = 0.5 + generator.random_sample(n)
    else:
        values = generator.standard_normal(n)
        if key.endswith("running_mean"):
            values = 0.1 * values
        elif len(shape) >= 2:
            values = values * np.sqrt(1.0 / (n / shape[0]))
        elif key.endswith((".weight", "a_2", "weight_g")):
            values = 1 + 0.1 * values
        else:
            values = 0.05 * values
    return torch.from_numpy(values.astype(np.float32).reshape(shape))


def state_dict(inventory, seed: int = 0) -> dict[str, torch.Tensor]:
    """``inventory``: (key, shape, dtype name) of every entry."""
    return {
        key: value(key, tuple(shape), dtype.startswith("float"), seed)
        for key, shape, dtype in inventory
    }


def inventory_of(network: torch.nn.Module):
    return [
        (key, tuple(tensor.shape), str(tensor.dtype).removeprefix("torch."))
        for key, tensor in network.state_dict().items()
    ]


def sha256(state: dict[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for tensor in state.values():
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()
