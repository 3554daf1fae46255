"""Metrics: pure functions on arrays, usable without pytest, data sets or methods."""

from pytest_cpas.metrics.surfaces import (
    Surface,
    SurfaceErrors,
    diameter,
    sample_surface,
    surface_errors,
)

__all__ = [
    "Surface",
    "SurfaceErrors",
    "diameter",
    "sample_surface",
    "surface_errors",
]
