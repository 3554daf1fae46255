"""The operators of torch that the ports run on a device, with the types that they are given.

A CPU does more than a GPU: products of integer matrices, say. ``cuda_operators.toml`` beside this
file lists what the ports need and a GPU does. It was made by

    python tests/ports/device_operators.py record

which adds what a port runs now, if torch's own table of operators has it for CUDA and its types are
not among those that are refused there (:func:`refused`).
"""

import re
import sys
import tomllib
from contextlib import ExitStack
from pathlib import Path
from unittest.mock import patch

import cases
import device_cases
import parity_cases
import torch
import torchgen

from method_adapters import _sdfest_together
from method_adapters._networks import graphs, icaps_refinement

LIST = Path(__file__).with_name("cuda_operators.toml")
#: What torch ships of the source of its operators.
TABLE = Path(torchgen.__file__).parent / "packaged/ATen/native/native_functions.yaml"
#: Operators that go to cuBLAS, cuDNN, cuSOLVER or kernels for floating types alone: products,
#: convolutions, interpolation, pooling, norms, decompositions, and functions of real numbers
#: (AT_DISPATCH_FLOATING_* in aten/src/ATen/native/cuda/{Blas,GridSampler,UpSample*,Adaptive*}.*).
FLOATING = re.compile(
    r"(mm|bmm|addmm|mv|matmul|linear|einsum|conv\dd|convolution|convolution_backward"
    r"|grid_sampler_.*|upsample_.*|adaptive_.*|max_pool.*|batch_norm|std_mean.*|(log_)?softmax.*"
    r"|linalg_.*|scaled_dot_.*|prelu|lerp.*)$"
)
FLOATS = {"float32", "float64"}


def ran(name: str) -> device_cases.Operators:
    """What a port runs in a prediction."""
    method, seen = parity_cases.method(name), parity_cases.observation(name)
    with ExitStack() as stack:
        # little of everything, and no graph: what is replayed is not told
        for module, limit, value in (
            (_sdfest_together, "PLACES", 1),
            (icaps_refinement, "STEPS", 2),
            (graphs, "MOST", 0),
        ):
            stack.enter_context(patch.object(module, limit, value))
        operators = stack.enter_context(device_cases.Operators())
        method.predict([seen], parity_cases.SEED)
    return operators


def read() -> dict[str, set[str]]:
    return {name: set(types) for name, types in tomllib.loads(LIST.read_text()).items()}


def unknown(seen: dict[str, set[torch.dtype]], listed: dict[str, set[str]]) -> list[str]:
    """What is seen and not listed."""
    return sorted(
        f"{name} of {str(dtype).removeprefix('torch.')}"
        for name, types in seen.items()
        for dtype in types or {"nothing"}
        if str(dtype).removeprefix("torch.") not in listed.get(name, ())
    )


def refused(listed: dict[str, set[str]]) -> list[str]:
    """What a list has that a GPU does not do."""
    there = on_cuda()
    return sorted(
        [f"{name}: torch has it not for CUDA" for name in listed if name not in there]
        + [
            f"{name} of {', '.join(sorted(types - FLOATS))}: for floating types alone"
            for name, types in listed.items()
            if FLOATING.match(name) and not types <= FLOATS
        ]
    )


def on_cuda() -> set[str]:
    """The operators that torch has for CUDA, or makes of others, by its own table."""
    entries: dict[str, str] = {}
    for entry in TABLE.read_text().split("\n- func: ")[1:]:
        entries[entry.partition("(")[0]] = entry

    def has(name: str) -> bool:
        entry = entries[name]
        delegate = re.search(r"structured_delegate: (\S+)", entry)
        if delegate:
            return has(delegate[1])
        keys = re.findall(r"^    ([\w, ]+):", entry.partition("dispatch:")[2], re.MULTILINE)
        # sums that are the same for every device are written once
        return (
            not keys
            or "ufunc_inner_loop:" in entry
            or any(
                key == "CUDA" or key.startswith("Composite")
                for each in keys
                for key in each.split(", ")
            )
        )

    return {name for name in entries if has(name)}


def record() -> None:
    listed: dict[str, set[str]] = {}
    with device_cases.as_on_a_device(setattr):
        for name in parity_cases.NAMES:
            for operator, types in ran(name).seen.items():
                kinds = {str(dtype).removeprefix("torch.") for dtype in types} or {"nothing"}
                listed.setdefault(operator, set()).update(kinds)
    if problems := refused(listed):
        sys.exit("\n".join(problems))
    lines = [f'"{name}" = {sorted(types)}' for name, types in sorted(listed.items())]
    LIST.write_text("\n".join(lines).replace("'", '"') + "\n")


if __name__ == "__main__":
    cases.command(__doc__, record)
