"""HTML as a tree: whatever comes from data is text in it, and cannot become markup."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias
from xml.etree.ElementTree import Element, tostring

from pytest_cpas.reading.text import html

Child: TypeAlias = "str | Element | Iterable[Child] | None"

__all__ = ["Child", "Element", "element", "page_text"]


def element(tag: str, *children: Child, **attributes: str | int | float | bool | None) -> Element:
    """An element; ``class_`` is the attribute class, and ``aria_label`` aria-label.

    An attribute that is None or False is left out, one that is True has no value.
    """
    made = Element(tag)
    for name, value in attributes.items():
        if value is not None and value is not False:
            made.set(name.rstrip("_").replace("_", "-"), "" if value is True else html(str(value)))
    for child in children:
        _append(made, child)
    return made


def _append(parent: Element, child: Child) -> None:
    if child is None:
        return
    if isinstance(child, Element):
        parent.append(child)
    elif not isinstance(child, str):
        for each in child:
            _append(parent, each)
    elif len(parent):
        parent[-1].tail = (parent[-1].tail or "") + html(child)
    else:
        parent.text = (parent.text or "") + html(child)


def page_text(root: Element) -> str:
    """The text of a page. The contents of script and style elements are not escaped."""
    return "<!DOCTYPE html>\n" + tostring(root, encoding="unicode", method="html") + "\n"
