"""Make ``docs/reference/metric-properties.md``: the properties, readable without the site."""

import re
from pathlib import Path

from reference.checks import offers, properties

PATH = Path(__file__).parents[1] / "docs" / "reference" / "metric-properties.md"

HEAD = """# Properties of metrics

Made by `tools/make_properties.py`. [Metric conformance](../metric-conformance.md) says how an
implementation is offered. A property is n/a where the metrics that it needs are not offered.

## What can be offered

"""


def page_text() -> str:
    """The text of the file."""
    # anchors of their own are for the site
    plain = re.sub(r" \{ #[\w-]+ \}$", "", properties(), flags=re.MULTILINE)
    return f"{HEAD}{offers()}\n\n## What must hold\n\n{plain}\n"


if __name__ == "__main__":
    PATH.write_text(page_text(), encoding="utf-8")
