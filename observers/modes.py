"""Names a mode of a linear system for people: where its pole is, and which states take part."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

ROUNDED = 1e-6  # 1/s, of a pole that is told
# Of the largest element of a mode, what still counts as a state of it.
SHARE = 0.1


def mode_name(pole: complex, vector: NDArray[np.generic], states: Sequence[str]) -> str:
    """`the mode at -2+3j 1/s in a, b` of a pole [1/s] and the states' parts in the mode, shape (n,)."""
    return f"the mode at {_number(pole)} 1/s in {taking_part(vector, states)}"


def taking_part(vector: NDArray[np.generic], states: Sequence[str]) -> str:
    """The names of the states whose parts, shape (n,), are not much smaller than the largest."""
    sizes = np.abs(vector)
    return ", ".join(name for name, size in zip(states, sizes, strict=True) if size >= SHARE * sizes.max())


def _number(pole: complex) -> str:
    real, imaginary = (0.0 if abs(part) < ROUNDED else float(part) for part in (pole.real, pole.imag))
    return f"{complex(real, imaginary):.4g}" if imaginary else f"{real:.4g}"
