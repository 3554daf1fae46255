"""What the type of a field cannot say of its values."""

from dataclasses import dataclass
from typing import Annotated


@dataclass(frozen=True, kw_only=True)
class Allowed:
    """Limits of a value, as metadata of :data:`typing.Annotated`; None is no limit.

    Where the value may be None, they are those of any other. Each is a keyword of JSON Schema:
    ``minimum`` and ``maximum`` are allowed themselves, ``above`` and ``below`` are not; ``pattern``
    is a regular expression for the text, and ``length`` how many items a list has.
    """

    minimum: float | None = None
    above: float | None = None
    maximum: float | None = None
    below: float | None = None
    pattern: str | None = None
    length: int | None = None

    def keywords(self) -> dict[str, float | str]:
        """The limits that there are, by their keywords."""
        limits = {
            "minimum": self.minimum,
            "exclusiveMinimum": self.above,
            "maximum": self.maximum,
            "exclusiveMaximum": self.below,
            "pattern": self.pattern,
            "minItems": self.length,
            "maxItems": self.length,
        }
        return {name: limit for name, limit in limits.items() if limit is not None}


#: How many there are; how many there are of what is not missing.
Natural = Annotated[int, Allowed(minimum=0)]
Positive = Annotated[int, Allowed(minimum=1)]

#: Times, factors and distances.
NotNegative = Annotated[float, Allowed(minimum=0)]
AboveZero = Annotated[float, Allowed(above=0)]

Share = Annotated[float, Allowed(minimum=0, maximum=1)]
Percent = Annotated[float, Allowed(minimum=0, maximum=100)]
