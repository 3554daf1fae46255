"""Conformance of metric implementations: properties that every one must keep.

Usable without pytest::

    from pytest_cpas.checks.metrics import PROPERTIES, check, load_subject

    subject = load_subject("my_package.my_adapter")
    for prop in PROPERTIES.values():
        result = check(subject, prop)
        print(prop.name, result.outcome, result.message)

``docs/metric-conformance.md`` says how an adapter is written.
"""

from pytest_cpas.checks.metrics.adapter import KNOWN, Box, Offer, Sample, offer
from pytest_cpas.checks.metrics.properties import PROPERTIES, Property
from pytest_cpas.checks.metrics.running import Result, as_subject, check, load_subject, replay
from pytest_cpas.checks.metrics.subject import Subject

# the modules register their properties when they are imported; the matrix follows this order
from pytest_cpas.checks.metrics import rotations as _rotations  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import boxes as _boxes  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import symmetric_boxes as _turned  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import box_corners as _box_corners  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import groups as _groups  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import upright_boxes as _upright  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import surfaces as _surfaces  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import large_surfaces as _large  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import precision as _precision  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import special_values as _special  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import areas as _areas  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import verdicts as _verdicts  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import average_precision as _average  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import detections as _detections  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import other_boxes as _others  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import counted as _counted  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import pose_detections as _poses  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import known_objects as _known  # isort: skip  # noqa: F401
from pytest_cpas.checks.metrics import conduct as _conduct  # isort: skip  # noqa: F401

__all__ = [
    "KNOWN",
    "PROPERTIES",
    "Box",
    "Offer",
    "Property",
    "Result",
    "Sample",
    "Subject",
    "as_subject",
    "check",
    "load_subject",
    "offer",
    "replay",
]
