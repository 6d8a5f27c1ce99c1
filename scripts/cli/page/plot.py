"""A plot as the page's script gets it: numbers in base64, colours and styles by name."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from headway.cli.page.thin import thin

Array = NDArray[Any]
Style = Literal["line", "thin", "dashed", "steps", "dots", "band", "bars"]

TIME = "time of the task [s]"


@dataclass(frozen=True)
class Curve:
    """One line of the legend. `values`: (m,), or (m, 2) for the two edges of a band."""

    label: str
    values: Array
    colour: str  # page.css has a variable of that name
    style: Style = "line"


@dataclass(frozen=True)
class Level:
    """A line across the plot, at a value of y."""

    value: float
    label: str
    reached: bool = True  # the axis reaches as far; else the line is there if it happens to be


@dataclass
class Plot:
    """Curves over one x axis."""

    title: str
    y: str  # what is drawn, with its unit
    x: str = TIME
    judged: bool = False  # the axis fits the task between its entry and its end
    log: bool = False  # the y axis
    upright: bool = False  # levels are values of x
    levels: list[Level] = field(default_factory=list)
    figures: list[str] = field(default_factory=list)  # beside the title
    _groups: list[dict[str, Any]] = field(default_factory=list, init=False)

    def add(self, x: Array, curves: Sequence[Curve], points: int) -> None:
        """Curves that share their x (m,), which rises; at most `points` of each are kept."""
        if not len(x):
            return
        columns = [np.asarray(c.values, dtype=np.float64).reshape(len(x), -1) for c in curves]
        kept_x, kept = thin(np.asarray(x, dtype=np.float64), np.hstack(columns), points)
        ends = np.cumsum([column.shape[1] for column in columns])[:-1]
        packed = [
            {
                "label": curve.label,
                "colour": curve.colour,
                "style": curve.style,
                "values": [pack(column) for column in values.T],
            }
            for curve, values in zip(curves, np.split(kept, ends, axis=1), strict=True)
        ]
        self._groups.append({"x": pack(kept_x), "curves": packed})

    @property
    def empty(self) -> bool:
        return not self._groups

    def tree(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "title": self.title,
            "x": self.x,
            "y": self.y,
            "time": self.x == TIME,
            "judged": self.judged,
            "log": self.log,
            "upright": self.upright,
            "figures": self.figures,
            "levels": [vars(level) for level in self.levels],
            "groups": self._groups,
        }


def pack(values: Array) -> str:
    """As float32 in base64. At 1 kHz such times are apart for two hours."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()
