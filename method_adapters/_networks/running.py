"""Reading published checkpoints, and running networks on a device."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from method_adapters._assets import AssetError, told_of_asset
from method_adapters._networks.graphs import Graphs, queued
from pytest_cpas.adapting import TorchTaps, heard_by, read_tensors

#: Where published checkpoints keep the weights, if not at the top.
NESTED = ("model", "state_dict", "aae_state_dict", "model_state_dict")


def read_checkpoint(path: Path) -> dict[str, Tensor]:
    """The tensors of a checkpoint by parameter name, on the CPU.

    Weights below a key of ``NESTED``, and names with the part ``module.`` that DataParallel puts
    in, become plain ones. Raises :class:`AssetError`.
    """
    with told_of_asset():
        content = read_tensors(path)
    for key in NESTED:
        if isinstance(content, Mapping) and isinstance(content.get(key), Mapping):
            content = content[key]
            break
    if not isinstance(content, Mapping) or not content:
        raise AssetError(f"{path}: it holds a {type(content).__name__}, expected named tensors")
    odd = [repr(key) for key in content if not isinstance(key, str)]
    if odd:
        raise AssetError(f"{path}: its tensors are called {_some(odd)}, expected names")
    other = [str(key) for key, value in content.items() if not isinstance(value, Tensor)]
    if other:
        raise AssetError(f"{path}: {_some(other)} are no tensors, expected tensors alone")
    return {
        ".".join(part for part in key.split(".") if part != "module"): value
        for key, value in content.items()
    }


def load_weights(network: nn.Module, path: Path, unused: Sequence[str] = ()) -> None:
    """Fill a network from a checkpoint that has its parameters, those that start with an entry of
    ``unused``, and no others. Raises :class:`AssetError`."""
    weights = {k: v for k, v in read_checkpoint(path).items() if not k.startswith(tuple(unused))}
    wanted = network.state_dict()
    # the counter of batch norm takes no part in inference; checkpoints older than it lack it
    missing = [k for k in wanted if k not in weights and not k.endswith(".num_batches_tracked")]
    extra = [k for k in weights if k not in wanted]
    other = [
        f"{k} {tuple(weights[k].shape)} for {tuple(wanted[k].shape)}"
        for k in wanted
        if k in weights and weights[k].shape != wanted[k].shape
    ]
    if missing or extra or other:
        seen = [
            f"{len(keys)} {what} ({_some(keys)})"
            for keys, what in (
                (missing, "missing"),
                (extra, "not known"),
                (other, "of other shape"),
            )
            if keys
        ]
        raise AssetError(
            f"{path} is not a checkpoint of {type(network).__name__}: of its {len(wanted)}"
            f" parameters {'; '.join(seen)}. Is it another method's, or another version's?"
        )
    network.load_state_dict(weights, strict=False)


def _some(keys: Sequence[str]) -> str:
    return ", ".join(keys[:3]) + (", ..." if len(keys) > 3 else "")


def device_named(name: str) -> torch.device:
    """Raises ValueError for a device that torch does not know or does not see."""
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise ValueError(f"device {name!r}: expected cpu, cuda or cuda:N") from error
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise ValueError(f"device {name!r}: torch {torch.__version__} sees {count} of them")
    return device


def full_precision() -> AbstractContextManager[None]:
    """Convolutions on a GPU are of full precision, and by the same algorithm from run to run."""
    flags: AbstractContextManager[None] = torch.backends.cudnn.flags(
        enabled=True, benchmark=False, deterministic=True, allow_tf32=False
    )
    return flags


class Runner:
    """A network in evaluation mode on a device; arrays in, arrays out."""

    def __init__(self, network: nn.Module, device: str) -> None:
        """Raises ValueError as :func:`device_named`."""
        self._device = device_named(device)
        self._network = network.eval().to(self._device)
        self._graphs = Graphs(self._network)

    def __call__(self, *inputs: NDArray[Any]) -> tuple[NDArray[np.float64], ...]:
        """The outputs for one batch of ``inputs``; always the same on one device."""
        _, outputs = self.on_device(*inputs)
        return arrays(outputs)

    def on_device(self, *inputs: NDArray[Any]) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """One batch of ``inputs`` and the outputs for it, where the network is."""
        with TorchTaps(self._network), torch.inference_mode(), full_precision():
            given = tuple(torch.from_numpy(x).to(self._device) for x in inputs)
            # a graph has no parts that could be tapped
            replayed = queued(given[0]) and heard_by() is None
            return given, (self._graphs if replayed else self._network)(*given)


def arrays(outputs: Sequence[Tensor]) -> tuple[NDArray[np.float64], ...]:
    """In host memory."""
    return tuple(output.cpu().double().numpy() for output in outputs)
