"""The networks that cpas_toolbox 1.0.0 publishes, as they run on a CPU:

    pip install --no-deps cpas_toolbox==1.0.0 absl-py "opencv-python-headless<5"

SGPA, DPDN and iCaps' LatentNet compile CUDA operators when they are imported; plain_kernels.py
takes their place. SDFEst's networks are those of another package, which is imported there.
"""

import contextlib
import importlib
import sys
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import asmnet_cases
import cases
import icaps_cases
import numpy as np
import plain_kernels
import torch

from pytest_cpas._open3d import import_open3d

#: What the peer imports for training, plots and files alone.
UNNEEDED = (
    *("cv2", "matplotlib", "matplotlib.pyplot", "tqdm", "torchvision", "torchvision.transforms"),
    *("sklearn", "sklearn.decomposition", "easydict", "transforms3d", "transforms3d.quaternions"),
)
KERNELS = {
    "pointnet2_sgpa": plain_kernels.Wrappers,
    "pointnet2_icaps": plain_kernels.Wrappers,
    "dpdn_pointnet2": plain_kernels.Functions,
}


def importer(monkeypatch):
    """What imports a module of the peer's methods."""
    for name in [n for n in UNNEEDED if find_spec(n.partition(".")[0]) is None]:
        monkeypatch.setitem(sys.modules, name, MagicMock())
    with contextlib.suppress(ImportError):
        import_open3d()
    compiled = SimpleNamespace(load=lambda name, **_: KERNELS[name])
    monkeypatch.setitem(sys.modules, "torch.utils.cpp_extension", compiled)
    methods = importlib.import_module("cpas_toolbox.cpas_methods")
    # its own __init__ imports the whole of the method
    icaps = ModuleType(f"{methods.__name__}._icaps")
    icaps.__path__ = [str(Path(methods.__file__).with_name("_icaps"))]
    monkeypatch.setitem(sys.modules, icaps.__name__, icaps)
    return lambda path: importlib.import_module(f"{methods.__name__}.{path}")


def rbppose_inputs():
    """What our network takes, and theirs, which makes points of a depth image."""
    random = np.random.default_rng(0)
    mask = np.zeros((256, 256), np.float32)
    mask.ravel()[random.permutation(256 * 256)[:1028]] = 1
    depth = np.float32(800) + 60 * random.random((256, 256), np.float32)
    rows, columns = np.mgrid[:256, :256].astype(np.float32)
    matrix = np.array([[1000, 0, 128], [0, 1010, 130], [0, 0, 1]], np.float32)
    prior, size = cases.priors()[5].astype(np.float32), np.float32([0.15, 0.08, 0.11])
    v, u = np.nonzero(mask)
    z = depth[v, u]
    x, y = (columns[v, u] - 128) * z / 1000, (rows[v, u] - 130) * z / 1010
    points = (np.stack([x, y, z], axis=1) / 1000).astype(np.float32)
    batch = {
        "rgb": np.zeros((3, 256, 256), np.float32),
        "depth": depth[None],
        "obj_id": np.array(5),
        "camK": matrix,
        "def_mask": mask[None],
        "mean_shape": size,
        "shape_prior": prior,
        "gt_2D": np.stack([columns, rows]),
    }
    given = [torch.from_numpy(x[None]) for x in (points, np.array(5), prior, size)]
    given += [torch.arange(n)[None] for n in (257, 64, 256, 64)]
    return given, {name: torch.from_numpy(x[None]) for name, x in batch.items()}


# -- per network: ours, theirs without weights, and how each is asked the same --------------------


def spd(peer, patch):
    return _prior_network(peer("_spd.spd.network"), "spd")


def crnet(peer, patch):
    return _prior_network(peer("_crnet.crnet.network"), "crnet")


def _prior_network(module, name):
    inputs = cases.network_inputs(name)
    theirs = module.DeformNet(n_cat=6, nv_prior=1024)
    return cases.network(name), theirs, lambda net: net(*inputs), lambda net: net(*inputs)


def sgpa(peer, patch):
    """Of the sample with repeated points, of which some are as far as others."""
    inputs = [x[1:] for x in cases.network_inputs("sgpa")]
    theirs = peer("_sgpa.sgpa.sgpa").SGPANet(num_structure_points=256)
    return cases.network("sgpa"), theirs, lambda net: net(*inputs), lambda net: net(*inputs)


def dpdn(peer, patch):
    inputs = [x[1:] for x in cases.network_inputs("dpdn")]
    named = dict(zip(("pts", "rgb", "choose", "category_label", "prior"), inputs, strict=True))
    resnet = peer("_dpdn.model.resnet")
    # it begins with downloaded weights, which are replaced
    patch(resnet.model_zoo, "load_url", lambda *_, **__: {})
    patch(resnet.ResNet, "load_state_dict", lambda *_, **__: None)
    theirs = peer("_dpdn.model.DPDN").Net()
    patch(torch.Tensor, "cuda", lambda self: self)
    return cases.network("dpdn"), theirs, lambda net: net(*inputs), lambda net: net(named)


def cass(peer, patch):
    inputs = [x[:1] for x in cases.network_inputs("cass")]
    points, image, choose, category = inputs

    def ask(net):
        shape = net.foldingnet.encode(image, points, choose)
        pose = net.estimator.encode(image, points, choose)
        net.estimator.pose(torch.cat([pose, shape], 1), category)
        net.foldingnet.recon(shape)

    theirs = peer("_cass").CASS(num_points=500, num_obj=6)
    return cases.network("cass"), theirs, lambda net: net(*inputs), ask


def asmnet(peer, patch):
    inputs = asmnet_cases.network_inputs()
    theirs = peer("_asmnet.ASM_Net.pointnet").ASM_Net(num_points=800, k=4)
    ours = asmnet_cases.network("mug")
    return ours, theirs, lambda net: net(*inputs), lambda net: net(*inputs)


def rbppose(peer, patch):
    """Where both take the first of everything."""
    patch(np, "int", int, raising=False)  # of older numpy
    patch(np.random, "choice", lambda count, size, replace: np.arange(size))
    patch(torch, "randperm", torch.arange)
    patch(torch.Tensor, "cuda", lambda self: self)
    given, batch = rbppose_inputs()
    theirs = peer("_rbppose").SSPN(...)
    return cases.network("rbppose"), theirs, lambda net: net(*given), lambda net: net(**batch)


def icaps_aae(peer, patch):
    module = peer("_icaps.models.aae_models")
    theirs = torch.nn.ModuleDict(
        {"encoder": module.encoder_depth(), "decoder": module.decoder_depth()}
    )
    crops = torch.from_numpy(np.random.RandomState(3).standard_normal((2, 1, 128, 128))).float()

    def ask(net):
        net["decoder"](net["encoder"](crops))

    return icaps_cases.network("icaps_aae"), theirs, lambda net: net.decoder(*net(crops)), ask


def icaps_latentnet(peer, patch):
    points = 0.5 * np.random.RandomState(3).standard_normal((1, 4873, 3))
    given = torch.from_numpy(points).float()
    theirs = peer("_icaps.models.pointnet2_msg").Pointnet2MSG(0)
    ours = icaps_cases.network("icaps_latentnet")
    return ours, theirs, lambda net: net(given), lambda net: net(given)


def icaps_deepsdf(peer, patch):
    random = np.random.RandomState(3)
    latent = torch.from_numpy(random.standard_normal((1, 256))).float()
    points = torch.from_numpy(random.uniform(-1, 1, (500, 3))).float()
    both = torch.cat([latent.expand(500, -1), points], 1)
    layers = {"norm_layers": range(8), "latent_in": [4], "weight_norm": True}
    theirs = peer("_icaps.deep_sdf.deep_sdf_decoder").Decoder(256, [512] * 8, **layers)
    ours = icaps_cases.network("icaps_deepsdf")
    return ours, theirs, lambda net: net(latent, points), lambda net: net.inference(both)
