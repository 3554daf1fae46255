"""The generated parts of the documentation: made of the code each time the site is built.

A page of ``docs/`` says where they go, in a line of its own::

    <!-- reference: options -->

and :func:`expand` puts them there. Nothing here needs mkdocs.
"""

import re

from reference import checks, code, files, metrics, options, protocols, registered, verdicts

#: What can stand in a marker; further words of it are passed on as text.
PARTS = {
    "api": code.api,
    "commands": options.commands,
    "contract": checks.contract,
    "dataset-checks": checks.dataset_checks,
    "dataset-limits": checks.dataset_limits,
    "dataset-words": verdicts.dataset_words,
    "datasets": registered.datasets,
    "definitions": metrics.definitions,
    "docstring": code.module_docstring,
    "exit-codes": verdicts.exit_codes,
    "facts": protocols.facts,
    "format": files.format_number,
    "golden-file": protocols.golden_file,
    "golden-words": verdicts.golden_words,
    "head": files.head,
    "ini": options.ini,
    "methods": registered.methods,
    "metric-functions": metrics.functions,
    "metric-implementations": registered.metric_implementations,
    "metric-outcomes": verdicts.metric_outcomes,
    "metric-properties": checks.properties,
    "offers": checks.offers,
    "options": options.options,
    "protocols": protocols.protocols,
    "readme": files.readme,
    "schema": files.schema,
    "speed-words": verdicts.speed_words,
    "parity-words": verdicts.parity_words,
}

_MARKER = re.compile(r"^<!-- reference: (\S+)(.*) -->$", re.MULTILINE)


def expand(markdown: str) -> str:
    """The page with its generated parts; ``KeyError`` for a marker that names no part."""
    return _MARKER.sub(lambda found: PARTS[found[1]](*found[2].split()), markdown)
