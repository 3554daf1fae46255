"""Protocols that ship, the facts that columns are made of, and a golden table as an example."""

from pytest_cpas.evaluation import Answer
from pytest_cpas.facts import all_facts, in_order
from pytest_cpas.golden import RunTable
from pytest_cpas.golden.tables import table_samples
from pytest_cpas.golden.texts import table_texts
from pytest_cpas.protocols import Protocol, facts_of, shipped_protocol, shipped_protocols
from reference.markdown import block, code, codes, heading, table


def protocols() -> str:
    """Every protocol that ships, with its columns as their files declare them."""
    parts = []
    for name in shipped_protocols():
        protocol = shipped_protocol(name)
        rows = []
        for column in protocol.columns:
            declared = column.declared()
            judged = {k: v for k, v in declared.items() if k not in ("id", "label", "guard")}
            told = "; ".join(f"{key} {_value(value)}" for key, value in judged.items())
            rows.append((code(column.id), column.label, told, "yes" if column.guard else ""))
        parts += [
            heading(3, code(name), f"protocol-{name}"),
            f"Version {protocol.version}: {protocol.title}. (Source: {protocol.source})",
            table(["id", "label", "judged by", "guard"], rows),
        ]
    return "\n\n".join(parts)


def _value(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{code(name)} {_limits(limits)}" for name, limits in value.items())
    return code(value)


def _limits(limits: object) -> str:
    if isinstance(limits, list):
        # two are the ends of an area
        return (" to " if len(limits) == 2 else ", ").join(f"{limit:g}" for limit in limits)
    return f"{limits:g}"


def facts() -> str:
    """Every fact, of the F-scores that of the paper."""
    rows = [
        (
            code(made.name),
            code(made.definition),
            made.unit or "-",
            made.better,
            codes(sorted(made.needs)) or "-",
            codes(sorted(made.knows)) or "-",
        )
        for made in all_facts()
    ]
    return table(
        ["fact", "definition", "unit", "better", "needs of the method", "needs of the data set"],
        rows,
    )


def golden_file(name: str) -> str:
    """A file of the golden table of a made-up run of two samples, under one column."""
    return block(table_texts(_golden())[name], name.rpartition(".")[2])


def _golden() -> RunTable:
    protocol = Protocol.parse(
        {"name": "mine", "columns": [{"id": "wide", "at": {"rotation_deg": 10, "iou": 0.5}}]}, ""
    )
    names = in_order(facts_of(protocol.columns))
    known = {made.name: made for made in all_facts()}
    answers = {
        "scene_1/0000/1": ("mug", (Answer(facts={"rotation_deg": 3.25, "iou": 0.8125}),)),
        "scene_1/0004/1": ("mug", (Answer(facts={"rotation_deg": 12.5, "iou": 0.75}),)),
    }
    return RunTable(
        method="my-method",
        dataset="synthetic-handheld",
        identity={"data": "5419ef...", "device": "cpu", "seed": "0"},
        definitions={name: known[name].definition for name in names},
        provenance={"numpy": "2.3.0", "platform": "Linux x86_64"},
        protocols=(protocol,),
        samples=table_samples([protocol], answers),
        listed={"mug": 2},
    )
