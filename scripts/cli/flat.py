"""A run's summary as columns: one value under each name."""

from __future__ import annotations

from typing import Any

Scalar = float | str | None  # or int, or bool


def flatten(summary: dict[str, Any]) -> dict[str, Scalar]:
    """`tracking.rms.q1` for the first entry of the list `rms` in `tracking`.

    Lists by state become `estimate.rms_now.position.q1` and `estimate.rms_now.velocity.q1`. The
    violated limits become one text, empty if there are none; the list of axes is left out.
    """
    axes = summary["axes"]
    flat: dict[str, Scalar] = {}
    for key, value in summary.items():
        if key == "limits_violated":
            flat[key] = "; ".join(value)
        elif key != "axes":
            flat |= _flat(key, value, axes)
    return flat


def _flat(name: str, value: Any, axes: list[str]) -> dict[str, Scalar]:
    if isinstance(value, dict):
        inner = [_flat(f"{name}.{key}", below, axes) for key, below in value.items()]
        return {key: scalar for part in inner for key, scalar in part.items()}
    if not isinstance(value, list):
        return {name: value}
    if len(value) == len(axes):
        return {f"{name}.{axis}": entry for axis, entry in zip(axes, value, strict=True)}
    states = [f"{name}.{which}.{axis}" for which in ("position", "velocity") for axis in axes]
    return dict(zip(states, value, strict=True))
