"""Modes of a linear system that do not die out, those of them that are not seen, and their names for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fmus.component import Vector

EPS = float(np.finfo(float).eps)
ROUNDED = 1e-6  # 1/s, of a pole that is told
# Of the largest element of a mode, what still counts as a state of it.
SHARE = 0.1


def growing_modes(A: Vector) -> list[complex]:
    """The eigenvalues of A with which a Gramian over all time does not exist, fastest growing first.

    One of a real part that is rounding, of the size of A, counts as zero, and so grows.
    """
    values = np.linalg.eigvals(A)
    least = EPS * len(A) * np.linalg.norm(A)
    return sorted((complex(v) for v in values if v.real >= -least), key=lambda v: -v.real)


def unseen_modes(A: Vector, C: Vector) -> list[complex]:
    """The modes that do not die out and that C does not see, by the test of Popov, Belevitch and Hautus."""
    return [mode for mode, _ in unseen_directions(A, C)]


def unseen_directions(A: Vector, C: Vector) -> list[tuple[complex, Vector]]:
    """The modes that do not die out and that C does not see, each with the states' parts in it, shape (n,)."""
    found = []
    for mode in growing_modes(A):
        _, values, right = np.linalg.svd(np.concatenate([A - mode * np.eye(len(A)), C]))
        if values[-1] <= np.sqrt(EPS) * values[0]:
            found.append((mode, np.abs(right[-1])))
    return found


def unseen_by_name(A: Vector, C: Vector, states: Sequence[str]) -> str:
    """Those modes, each with the states (n,) that take part, whatever sizes the rows of C have; empty: all are seen."""
    rows = C / np.maximum(np.linalg.norm(C, axis=1, keepdims=True), np.finfo(float).tiny)
    named = (mode_name(mode, vector, states) for mode, vector in unseen_directions(A, rows))
    return ", nor ".join(dict.fromkeys(named))


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
