"""Writes numbers for readers: four significant digits, units beside them, infinities and gaps in words."""

from __future__ import annotations

import math


def short(value: float, digits: int = 4) -> str:
    """The number with up to `digits` significant digits, like 0.01234, 1.2e-5 or 350; `∞` and `n/a` for the rest."""
    if math.isnan(value):
        return "n/a"
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    if 0 <= int(exponent) < 7:
        return f"{value:.0f}"
    return f"{mantissa}e{int(exponent)}"


def known(value: float | None) -> str:
    """The number as `short` writes it; `-` for none."""
    return "-" if value is None else short(float(value))


def with_unit(value: float, unit: str, digits: int = 4) -> str:
    """The number and its unit; a pure number stands alone."""
    return short(value, digits) if unit in ("", "1") or math.isnan(value) else f"{short(value, digits)} {unit}"


def axis_label(text: str, unit: str) -> str:
    """The text with a unit behind it, as axes are labelled; a pure number has none."""
    return text if unit in ("", "1") else f"{text} [{unit}]"


def duration(seconds: float) -> str:
    """A wall time as s, min or h."""
    if seconds < 120:
        return f"{short(seconds, 3)} s"
    return f"{short(seconds / 60, 3)} min" if seconds < 7200 else f"{short(seconds / 3600, 3)} h"
