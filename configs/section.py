"""What every part of a config is made of: checked numbers and sections without unknown keys."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

SMALL, LARGE = 1e-9, 1e12  # what is beyond, in any unit, is a slip of the pen
Positive = Annotated[float, Field(ge=SMALL, le=LARGE, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, le=LARGE, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-LARGE, le=LARGE, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Delay = Annotated[int, Field(ge=0, le=10_000_000)]  # us
ByAxis = NotNegative | list[NotNegative]  # one for all axes, or one each


def by_axis(value: float | list[float], axes: int) -> list[float]:
    """A value for each axis."""
    return value if isinstance(value, list) else [value] * axes


class Section(BaseModel):
    """Unknown keys and wrong types are errors; nothing changes after loading.

    A key's name says its unit. Where the unit depends on the kind of axis, the attribute's name
    leaves it out: `position_min` is read from `position_min_rad` or `position_min_m`.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        serialize_by_alias=True,
        use_attribute_docstrings=True,  # for editors and docs/config.md
    )

    @classmethod
    def key(cls, attribute: str) -> str:
        """The name of an attribute in the file."""
        return cls.model_fields[attribute].alias or attribute
