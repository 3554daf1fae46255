"""Methods that declare what they should not, or in their own way."""

# ruff: noqa: RUF012 - as such methods are written
import numpy as np
from planted_methods import Good


class NoPredict:
    info = Good.info

    def load(self, assets, device):
        pass


class ListForInfo(Good):
    info = [1]


class LongLicence(Good):
    info = dict(Good.info, licence="x" * 50000000)


class DeclaredInNumpy(Good):
    info = dict(
        Good.info,
        categories=np.array(["mug"]),
        deterministic=np.bool_(True),
        tolerance=np.float32(0.25) / 1024,
    )
