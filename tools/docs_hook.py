"""What mkdocs calls when it builds the site (``hooks`` in ``mkdocs.yml``)."""

import re

from mkdocs.exceptions import PluginError
from reference import expand

#: What a page would fetch from elsewhere when it is looked at.
_FETCHED = re.compile(
    r'<(?:script|img|iframe|source)\b[^>]*\bsrc="https?:|<link\b[^>]*href="https?:'
)


def on_page_markdown(markdown: str, **_: object) -> str:
    """Put the generated parts where a page wants them."""
    # GitHub reads Markdown in there, Python-Markdown when it is told to
    return expand(markdown).replace("<details>", "<details markdown>")


def on_post_page(output: str, page: object, **_: object) -> str:
    """The site needs no network: refuse a page that fetches something."""
    if found := _FETCHED.search(output):
        raise PluginError(f"{page}: it fetches {found[0]}...; the site must work without network")
    return output
