"""What goes wrong with values that cross the border, and whose fault it is."""

from __future__ import annotations

__all__ = ["ContractError"]


class ContractError(ValueError):
    """A value breaks the contract between the harness and a method or a data set."""
