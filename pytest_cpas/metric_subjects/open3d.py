"""Open3D: distances between point clouds."""

from typing import Any

import numpy as np

from pytest_cpas._open3d import import_open3d
from pytest_cpas.checks.metrics import offer

o3d = import_open3d()


def _distances(source: Any, target: Any) -> Any:
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (source, target)]
    return np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))


METRICS = {
    "average_distance": offer(lambda a, b: _distances(a, b).mean()),
    "chamfer": offer(lambda a, b: (_distances(a, b).mean() + _distances(b, a).mean()) / 2),
    "surface_precision": offer(lambda a, b, limit: (_distances(b, a) < limit).mean()),
    "surface_recall": offer(lambda a, b, limit: (_distances(a, b) < limit).mean()),
}
