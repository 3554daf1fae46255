"""What the ports of published methods declare."""

from __future__ import annotations

from typing import Literal

from pytest_cpas.adapting import CATEGORIES, Asset, MethodInfo

#: Where code or weights were published without a licence.
PORT_ALONE = "MIT (this port; the weights state no licence)"


def port_info(
    name: str,
    *assets: Asset,
    needs: frozenset[Literal["rgb", "depth"]] = frozenset({"rgb", "depth"}),
    gives: frozenset[Literal["extents", "shape", "score"]] = frozenset({"extents", "shape"}),
    licence: str = PORT_ALONE,
    object_frame: Literal["nocs", "shapenet"] = "nocs",
    categories: tuple[str, ...] = CATEGORIES,
) -> MethodInfo:
    """The declaration of a port; what most have in common goes without saying."""
    return MethodInfo(
        name=name,
        categories=categories,
        needs=needs,
        gives=gives,
        licence=licence,
        object_frame=object_frame,
        assets=assets,
    )
