"""The ported networks against those of cpas_toolbox 1.0.0, and the PointNet++ operators against
plain torch; one object, batch 1, CPU, same process.

    pip install --no-deps cpas_toolbox==1.0.0 absl-py
    OMP_NUM_THREADS=1 python benchmarks/bench_ports.py

Ends with an error if a peer with the same weights differs by more than 1e-5. SGPA's and DPDN's
published networks need CUDA extensions to be built: they are timed without a peer. RBP-Pose's asks
for a GPU in one place, which is taken out, and draws points, here always the first ones.
"""

from __future__ import annotations

import importlib
import resource
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np
import torch
from torch import Tensor, nn

from method_adapters._networks import pointnet2
from method_adapters._networks.asmnet import AsmNet
from method_adapters._networks.cass import CassNet
from method_adapters._networks.crnet import CrNet
from method_adapters._networks.dpdn import DpdnNet
from method_adapters._networks.rbppose import RbpPoseNet
from method_adapters._networks.sgpa import SgpaNet
from method_adapters._networks.spd import SpdNet
from pytest_cpas._open3d import import_open3d

NETWORKS = {
    "spd": SpdNet,
    "crnet": CrNet,
    "sgpa": SgpaNet,
    "dpdn": DpdnNet,
    "cass": CassNet,
    "rbppose": RbpPoseNet,
    "asmnet": AsmNet,
}
Outputs = Callable[[], Sequence[Tensor]]


def medians(*functions: Callable[[], object], repeats: int) -> list[float]:
    """Milliseconds, the functions taking turns so that all see the same machine."""
    times: list[list[float]] = [[] for _ in functions]
    for function in functions:
        function()
    for _ in range(repeats):
        for function, kept in zip(functions, times, strict=True):
            start = time.perf_counter()
            function()
            kept.append(1000 * (time.perf_counter() - start))
    return [statistics.median(kept) for kept in times]


def peer_module(path: str) -> ModuleType:
    """A published network; what its package imports for training and plots alone is left out."""
    names = ("cv2", "matplotlib", "matplotlib.pyplot", "tqdm")
    names += ("torchvision", "torchvision.transforms", "sklearn", "sklearn.decomposition")
    for name in [n for n in names if n not in sys.modules]:
        if name.partition(".")[0] in sys.modules or find_spec(name) is None:
            sys.modules[name] = MagicMock()
    import_open3d()
    return importlib.import_module(f"cpas_toolbox.cpas_methods.{path}")


def inputs(name: str) -> list[Tensor]:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand((1, 1028, 3), generator=generator) * torch.tensor([0.12, 0.2, 0.1])
    points += torch.tensor([0.0, 0, 0.8])
    image = torch.randn((1, 3, 192, 192), generator=generator)
    choose = torch.randint(0, 192 * 192, (1, 1024), generator=generator)
    category, prior = torch.tensor([5]), torch.rand((1, 1024, 3), generator=generator) - 0.5
    if name == "cass":
        return [points[:, :500], image, choose[:, :500], category]
    if name == "asmnet":
        return [(points[:, :800] - torch.tensor([0.06, 0.1, 0.85])).mT.contiguous() * 8]
    if name == "rbppose":
        kept = [torch.arange(n)[None] for n in (257, 64, 256, 64)]
        return [points, category, prior, torch.tensor([[0.1, 0.2, 0.1]]), *kept]
    return [points[:, :1024], image, choose, category, prior]


def deform_net(path: str) -> Callable[[dict[str, Tensor], list[Tensor]], Outputs]:
    def published(weights: dict[str, Tensor], given: list[Tensor]) -> Outputs:
        network = peer_module(path).DeformNet(n_cat=6, nv_prior=1024).eval()
        network.load_state_dict(weights, strict=True)
        return lambda: network(*given)

    return published


def published_cass(weights: dict[str, Tensor], given: list[Tensor]) -> Outputs:
    network = peer_module("_cass").CASS(num_points=500, num_obj=6).eval()
    network.load_state_dict(weights, strict=False)
    points, image, choose, category = given

    def outputs() -> list[Tensor]:
        shape = network.foldingnet.encode(image, points, choose)
        pose = network.estimator.encode(image, points, choose)
        r, t, c = network.estimator.pose(torch.cat([pose, shape], 1), category)
        return [r, t, c[..., 0], network.foldingnet.recon(shape)]

    return outputs


def published_rbppose(weights: dict[str, Tensor], given: list[Tensor]) -> Outputs:
    torch.Tensor.cuda = lambda self: self
    np.random.choice = lambda count, size, replace: np.arange(size)
    torch.randperm = torch.arange
    network = peer_module("_rbppose").SSPN(...).eval()
    network.load_state_dict(weights, strict=False)
    points, category, prior, size, *_ = given
    # the crop of a camera that sees the points, one in each of the first pixels
    depth, mask, places = torch.zeros(3, 256 * 256), torch.zeros(256 * 256), slice(0, 1028)
    depth[2, places], mask[places] = 1000 * points[0, :, 2], 1
    depth[:2, places] = (points[0, :, :2] / points[0, :, 2:]).T
    batch = {
        "rgb": torch.zeros(1, 3, 256, 256),
        "depth": depth[2].view(1, 1, 256, 256),
        "obj_id": category,
        "camK": torch.eye(3)[None],
        "def_mask": mask.view(1, 1, 256, 256),
        "mean_shape": size,
        "shape_prior": prior,
        "gt_2D": depth[:2].view(1, 2, 256, 256),
    }
    names = ("p_green_R", "p_red_R", "f_green_R", "f_red_R", "Pred_T", "Pred_s", "recon_model")

    def outputs() -> list[Tensor]:
        found = network(**batch)
        *others, shape = (found[name] for name in names)
        return [*others, shape - prior]

    return outputs


def published_asmnet(weights: dict[str, Tensor], given: list[Tensor]) -> Outputs:
    network = peer_module("_asmnet.ASM_Net.pointnet").ASM_Net(num_points=800, k=4).eval()
    network.load_state_dict(weights, strict=True)
    return lambda: network(*given)


PEERS = {
    "spd": deform_net("_spd.spd.network"),
    "crnet": deform_net("_crnet.crnet.network"),
    "cass": published_cass,
    "rbppose": published_rbppose,
    "asmnet": published_asmnet,
}


def networks() -> None:
    for name, make in NETWORKS.items():
        torch.manual_seed(0)
        ours: nn.Module = make().eval()
        for parameter in ours.parameters():
            if parameter.ndim > 1:
                nn.init.normal_(parameter, std=parameter[0].numel() ** -0.5)
        given = inputs(name)
        if name not in PEERS:
            (ms,) = medians(lambda net=ours, x=given: net(*x), repeats=9)
            print(f"{name:7} ours {ms:7.1f} ms   published: needs CUDA extensions")
            continue
        theirs = PEERS[name](ours.state_dict(), given)
        pairs = zip(ours(*given), theirs(), strict=True)
        worst = max(float((x - y).norm() / y.norm()) for x, y in pairs)
        mine, published = medians(lambda net=ours, x=given: net(*x), theirs, repeats=9)
        print(
            f"{name:7} ours {mine:7.1f} ms   published {published:7.1f} ms   ratio"
            f" {mine / published:.2f} (at most 1)   difference {worst:.1e}"
        )
        if worst > 1e-5:
            sys.exit(f"{name}: it is not the published network")


def plain_farthest_points(xyz: Tensor, count: int) -> Tensor:
    chosen = torch.zeros((len(xyz), count), dtype=torch.int64)
    running = torch.full(xyz.shape[:2], torch.inf)
    rows = torch.arange(len(xyz))
    for i in range(1, count):
        last = xyz[rows, chosen[:, i - 1]][:, None]
        running = torch.minimum(running, ((xyz - last) ** 2).sum(-1))
        chosen[:, i] = running.argmax(-1)
    return chosen


def plain_ball_query(distances: Tensor, radius: float, count: int) -> Tensor:
    n = distances.shape[-1]
    index = torch.arange(n).expand_as(distances).clone()
    index[distances >= radius**2] = n
    index = index.sort(-1).values[..., :count]
    return torch.where(index == n, index[..., :1], index)


def plain_three_nearest(unknown: Tensor, known: Tensor) -> tuple[Tensor, Tensor]:
    squared = ((unknown[:, :, None] - known[:, None]) ** 2).sum(-1)
    found = squared.topk(3, dim=-1, largest=False)
    return found.values, found.indices


def operators() -> None:
    xyz = inputs("sgpa")[0]
    centres = pointnet2.gather(xyz.mT, pointnet2.farthest_points(xyz, 512, max_threads=1024)).mT
    distances = pointnet2.squared_distances(centres, xyz)
    pairs = {
        "farthest points, 512 of 1024": (
            lambda: pointnet2.farthest_points(xyz, 512, max_threads=1024),
            lambda: plain_farthest_points(xyz, 512),
        ),
        "ball query, 512 centres, 32 of 1024": (
            lambda: pointnet2.ball_query(distances, 0.02, 32),
            lambda: plain_ball_query(distances, 0.02, 32),
        ),
        "three nearest, 1024 in 512": (
            lambda: pointnet2.three_nearest(xyz, centres),
            lambda: plain_three_nearest(xyz, centres),
        ),
    }
    for name, (ours, plain) in pairs.items():
        mine, theirs = medians(ours, plain, repeats=61)
        print(
            f"{name:38} ours {mine:6.2f} ms   plain {theirs:6.2f} ms   ratio {mine / theirs:.2f}"
            " (at most 1.2)"
        )


if __name__ == "__main__":
    torch.set_num_threads(1)
    np.seterr(all="raise")
    with torch.inference_mode():
        operators()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"peak memory with the operators {peak:.2f} GiB (at most 1)")
        networks()
