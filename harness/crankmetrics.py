"""What repeats with the crankshaft: averages over crank windows, crank-locked error, harmonics of the cycle."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from fmus.component import Signal
from harness.arguments import CrankRows, Pair, Result, SignedError, expanded
from harness.crankrows import OverCrank, Spacing, by_cycle, window_means
from harness.quantity import Measure, Quantity
from harness.window import Window, degrees

Vector = NDArray[np.float64]


def crank_average(
    spacing: Spacing, signal: Vector, start: float, stop: float, tdc: Mapping[str, float]
) -> Mapping[str, float]:
    """Mean over the cycles of the mean over a crank window: of the rows with from <= crank angle < to, in each cycle.

    With m_i the mean of window i: the value is mean(m_i), `std` sqrt(sum((m_i - mean)^2)/(windows - 1)), `cov` std over
    |mean| in SI, `windows` how many lie whole in the rows. With cylinders, the window of each is counted from its
    firing top dead centre, m_i is over all of them, `cylinder_k` is the mean of cylinder k and `spread` the largest of
    those less the smallest. Rows (n,) are at equal crank angles; NaN without a whole window.
    """
    by_cylinder = {
        name: window_means(signal, spacing, start + at, stop + at) for name, at in (tdc or {"": 0.0}).items()
    }
    pooled = np.concatenate(list(by_cylinder.values()))
    mean = _mean(pooled)
    std = float(np.std(pooled, ddof=1)) if len(pooled) > 1 else np.nan
    means = {name: _mean(found) for name, found in by_cylinder.items()}
    return {
        "": mean,
        "std": std,
        "cov": std / abs(mean) if mean else np.nan,
        "windows": float(len(pooled)),
        "spread": max(means.values()) - min(means.values()),
        **{f"cylinder_{name}": value for name, value in means.items()},
    }


def crank_error(spacing: Spacing, truth: Vector, estimate: Vector) -> Mapping[str, float]:
    """RMSE of the error that repeats every cycle: sqrt(mean_j(E_j^2)), E_j its mean over the cycles at crank angle j.

    `max` is max |E_j|, `scatter` the RMS of the rest, e - E_j: over the same rows rmse^2 = crank_error^2 + scatter^2.
    `cycles` are the whole cycles from the first row on, `dropped` [deg] the crank angle of the rows after them. Truth
    and estimate (n,) are at equal crank angles; NaN without a whole cycle.
    """
    error = by_cycle(estimate - truth, spacing)
    used = _used(truth, spacing)
    if not len(error):
        return {"": np.nan, "max": np.nan, "scatter": np.nan, **used}
    locked = np.mean(error, axis=0)
    error -= locked
    return {
        "": float(np.sqrt(np.mean(locked**2))),
        "max": float(np.max(np.abs(locked))),
        "scatter": float(np.sqrt(np.mean(error**2))),
        **used,
    }


def harmonic(spacing: Spacing, signal: Vector, per_cycle: int) -> Mapping[str, float]:
    """Amplitude of the harmonic with k oscillations a cycle, by the discrete Fourier transform over whole cycles.

    x = mean + sum_k A_k cos(k w theta + phi_k), w = 360 deg/cycle, theta the crank angle: the value is A_k > 0, `phase`
    phi_k in (-180, 180] deg of the oscillation. `cycles` are the whole cycles from the first row on, `dropped` [deg]
    the crank angle of the rows after them. Rows (n,) are at equal crank angles, more than 2 k a cycle; else NaN.
    """
    found = _harmonic(spacing, signal, per_cycle)
    return {"": float(np.abs(found)), "phase": float(np.degrees(np.angle(found))), **_used(signal, spacing)}


def harmonic_error(spacing: Spacing, truth: Vector, estimate: Vector, per_cycle: int) -> Mapping[str, float]:
    """Amplitude of the harmonic with k oscillations a cycle in the error, estimate minus truth.

    |A' e^(i phi') - A e^(i phi)| with A, phi of the truth and A', phi' of the estimate as in `harmonic`; `amplitude` is
    A' - A, `phase` phi' - phi in (-180, 180] deg of the oscillation. `cycles` and `dropped` as in `harmonic`.
    """
    true, seen = _harmonic(spacing, truth, per_cycle), _harmonic(spacing, estimate, per_cycle)
    return {
        "": float(np.abs(seen - true)),
        "amplitude": float(np.abs(seen) - np.abs(true)),
        "phase": float(np.degrees(np.angle(seen * np.conj(true)))),
        **_used(truth, spacing),
    }


def _harmonic(spacing: Spacing, signal: Vector, per_cycle: int) -> complex:
    """A_k e^(i phi_k) of rows at equal crank angles."""
    cycles = by_cycle(signal, spacing)
    if not len(cycles) or 2 * per_cycle >= spacing.per_cycle:
        return complex(np.nan, np.nan)
    angles = spacing.angles(spacing.per_cycle) * (2.0 * np.pi * per_cycle / (spacing.apart * spacing.per_cycle))
    return complex(2.0 * np.mean(np.mean(cycles, axis=0) * np.exp(-1j * angles)))


def _used(values: Vector, spacing: Spacing) -> dict[str, float]:
    cycles, rest = divmod(len(values), spacing.per_cycle)
    return {"cycles": float(cycles), "dropped": rest * spacing.apart}


def _mean(values: Vector) -> float:
    return float(np.mean(values)) if len(values) else np.nan


class CrankAverage(OverCrank):
    """A signal, the crank window it is averaged in, and the cylinders where each has its own."""

    signal: str = Field(description="its name, as part.output")
    start: Quantity = Field(Measure(0.0, "deg"), alias="from", description="crank angle the window starts at")
    stop: Quantity | None = Field(None, alias="to", description="crank angle it ends before; a cycle on where absent")
    firing_order: list[int] = Field(
        default_factory=list, description="the cylinders as they fire, like [1, 3, 4, 2]: a window for each"
    )
    tdc: list[Quantity] = Field(
        default_factory=list,
        description="firing top dead centres in firing order; evenly spaced from 0 deg where absent",
    )

    @model_validator(mode="after")
    def _a_window(self) -> CrankAverage:
        start, stop = self.window
        if not start < stop <= start + degrees(self.cycle) * (1 + 1e-12):
            raise ValueError(f"wants from < to <= from + {self.cycle}, got from {self.start} to {self.stop}")
        if len(set(self.firing_order)) < len(self.firing_order):
            raise ValueError(f"firing_order wants each cylinder once, got {self.firing_order}")
        if self.tdc and len(self.tdc) != len(self.firing_order):
            raise ValueError(f"tdc wants one angle a cylinder of firing_order: {len(self.firing_order)}")
        for angle in self.tdc:
            degrees(angle)
        return self

    @property
    def window(self) -> tuple[float, float]:
        """Where it starts and ends [deg]."""
        start = degrees(self.start)
        return start, start + degrees(self.cycle) if self.stop is None else degrees(self.stop)

    def names(self) -> list[str]:
        """The signal."""
        return [self.signal]

    def results(self, offered: Mapping[str, Result]) -> Mapping[str, Result]:
        """One value a cylinder, and their spread where there are cylinders."""
        cylinders = map(str, self.firing_order)
        known = expanded(offered, "cylinder", cylinders)
        return {name: result for name, result in known.items() if self.firing_order or name != "spread"}

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(spacing, signal, start and end of the window [deg], top dead centre of each cylinder [deg])."""
        count = len(self.firing_order)
        even = [index * degrees(self.cycle) / count for index in range(count)]
        at = [degrees(angle) for angle in self.tdc] or even
        return *super().arrays(window), *self.window, dict(zip(map(str, self.firing_order), at, strict=True))

    def crank_misfits(self, rows: CrankRows) -> list[str]:
        """Also a window narrower than the rows are apart."""
        messages, apart = super().crank_misfits(rows), self.apart(rows)
        start, stop = self.window
        if not messages and apart is not None and stop - start < apart * (1 - 1e-9):
            messages.append(f"wants a window as wide as its rows are apart, {apart:g} deg, got {stop - start:g} deg")
        return messages


class CrankError(OverCrank):
    """The error of one pair [truth, estimate] over crank angle."""

    error: SignedError = Field(description="[truth, estimate]")

    @model_validator(mode="after")
    def _no_scales(self) -> CrankError:
        if self.error.scales is not None:
            raise ValueError("wants an error without scales")
        return self

    def names(self) -> list[str]:
        """Truth and estimate."""
        return self.error.names()

    def compared(self) -> list[Pair]:
        """The pair."""
        return self.error.compared()

    def misfits(self, signals: Mapping[str, Signal]) -> list[str]:
        """Those of the error."""
        return self.error.misfits(signals)


def oscillation_misfits(per_cycle: int, measured: OverCrank, rows: CrankRows) -> list[str]:
    """A harmonic that the rows are too far apart for."""
    apart = measured.apart(rows)
    a_cycle = round(degrees(measured.cycle) / apart) if apart is not None else None
    if a_cycle is None or 2 * per_cycle < a_cycle:
        return []
    return [f"per_cycle wants less than half of the {a_cycle} rows a cycle, got {per_cycle}"]


class Harmonic(OverCrank):
    """A signal and the harmonic of it that is wanted."""

    signal: str = Field(description="its name, as part.output")
    per_cycle: int = Field(ge=1, description="oscillations a cycle: 4 is the second engine order of a four-stroke")

    def names(self) -> list[str]:
        """The signal."""
        return [self.signal]

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(spacing, signal, oscillations a cycle)."""
        return *super().arrays(window), self.per_cycle

    def crank_misfits(self, rows: CrankRows) -> list[str]:
        """Also a harmonic that the rows are too far apart for."""
        return super().crank_misfits(rows) or oscillation_misfits(self.per_cycle, self, rows)


class HarmonicError(CrankError):
    """The error of one pair and the harmonic of it that is wanted."""

    per_cycle: int = Field(ge=1, description="oscillations a cycle: 4 is the second engine order of a four-stroke")

    def arrays(self, window: Window) -> tuple[Any, ...]:
        """(spacing, truth, estimate, oscillations a cycle)."""
        return *super().arrays(window), self.per_cycle

    def crank_misfits(self, rows: CrankRows) -> list[str]:
        """Also a harmonic that the rows are too far apart for."""
        return super().crank_misfits(rows) or oscillation_misfits(self.per_cycle, self, rows)
