"""The metrics: functions, and definitions with their ids."""

from pytest_cpas import metrics
from pytest_cpas.metrics import DEFINITIONS
from reference import code as reader
from reference.markdown import code, codes, table


def functions() -> str:
    """Everything that :mod:`pytest_cpas.metrics` exports."""
    exported = reader.members(metrics).items()
    ordered = sorted(exported, key=lambda pair: pair[0].lower())
    return "\n\n".join(reader.documented(f"pytest_cpas.metrics.{k}", v) for k, v in ordered)


def definitions() -> str:
    """The table of definitions."""
    return table(
        ["id", "unit", "better", "parameters", "source"],
        (
            (
                code(f"{entry.name}:{entry.variant}:{entry.version}"),
                entry.unit or "-",
                entry.better,
                codes(entry.parameters) or "-",
                entry.source,
            )
            for entry in DEFINITIONS.values()
        ),
    )
