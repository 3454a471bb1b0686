"""What an observer of a periodic input tells: the signal, its coefficients and the energies of its harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fmus.component import Signal
from observers.periodic_response import Pair, product


def endings(count: int) -> list[str]:
    """What the names of several signals alike end in; nothing where there is one."""
    return [""] if count == 1 else [f"_{j}" for j in range(1, count + 1)]


def told_signals(reconstructed: Sequence[Signal], begins: Sequence[float], harmonics: int) -> list[Signal]:
    """The signals themselves, which begin with `begins`, then c_0, c_k_re, c_k_im and E_k of each."""
    outputs = [
        Signal(signal.name, signal.unit, start, signal.description, signal.nominal)
        for signal, start in zip(reconstructed, begins, strict=True)
    ]
    for end, signal, start in zip(endings(len(reconstructed)), reconstructed, begins, strict=True):
        outputs.append(Signal(f"c_0{end}", signal.unit, start, f"mean of {signal.name}"))
        for k in range(1, harmonics + 1):
            what = f"its coefficient at {k} per period"
            outputs.append(Signal(f"c_{k}_re{end}", signal.unit, 0.0, f"real part of {what}"))
            outputs.append(Signal(f"c_{k}_im{end}", signal.unit, 0.0, f"imaginary part of {what}"))
            outputs.append(Signal(f"E_{k}{end}", signal.unit, 0.0, f"energy of harmonic {k}: sqrt(|c_k|^2 + |c_-k|^2)"))
    return outputs


def told_values(
    reconstructed: Sequence[Signal], coefficients: Sequence[Sequence[Pair]], turns: Sequence[Pair]
) -> dict[str, Any]:
    """Their values of coefficients (h + 1 lists of one pair a signal); `turns` are those of k w0 alpha."""
    values = dict(zip([signal.name for signal in reconstructed], sum_of(coefficients, turns), strict=True))
    for k, row in enumerate(coefficients):
        for end, (re, im) in zip(endings(len(reconstructed)), row, strict=True):
            if k == 0:
                values[f"c_0{end}"] = re
            else:
                values |= {f"c_{k}_re{end}": re, f"c_{k}_im{end}": im}
                values[f"E_{k}{end}"] = np.sqrt(2.0 * (re * re + im * im))
    return values


def sum_of(coefficients: Sequence[Sequence[Pair]], turns: Sequence[Pair]) -> list[Any]:
    """w = c_0 + 2 sum Re(c_k e^{i k w0 alpha}), (m,)."""
    values = [re for re, _ in coefficients[0]]
    for row, turn in zip(coefficients[1:], turns[1:], strict=True):
        values = [v + 2.0 * product(c, turn)[0] for v, c in zip(values, row, strict=True)]
    return values
