"""Draw where the objects' up axes of REAL275 and REDWOOD75 point, seen from the camera.

The paper's figure of the two data sets: all 16118 poses of REAL275's ground truth, and the 75 of
REDWOOD75. Writes ``up_axes.png`` beside this file and prints what the picture shows:

    python docs/figures/up_axes.py DATA

``DATA`` holds ``redwood75/annotations.json`` with its meshes, and REAL275's ground truth as an
array ``gt_RTs`` (16118, 4, 4) in ``predictions/dualposenet_real275.npz``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from pytest_cpas.checks.dataset.orientations import up_axis_spread
from pytest_cpas.datasets.redwood import Redwood75
from pytest_cpas.report.sphere_picture import draw_up_axes


def main(data: Path) -> None:
    """Read the poses, print and draw."""
    with np.load(data / "predictions" / "dualposenet_real275.npz", allow_pickle=False) as stored:
        scaled = stored["gt_RTs"][:, :3, :3]
    # y is the up axis of NOCS and ShapeNet objects alike; the columns still carry the scale
    up = scaled[:, :, 1] / np.linalg.norm(scaled[:, :, 1], axis=1, keepdims=True)
    redwood = Redwood75(data)
    freely = np.array([redwood.truth(ref).pose.rotation[:, 1] for ref in redwood.samples])
    axes = {"REAL275": up, "REDWOOD75": freely}
    for name, directions in axes.items():
        print(name, up_axis_spread(directions))
    print("wrote", draw_up_axes(axes, Path(__file__).with_suffix(".png")).name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
