"""Which cylinder works more than the others: the variance of the speed next to the cylinders, stroke by stroke."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from fmus.component import Signal
from fmus.crankcycle import passes
from fmus.model import Model, Values
from observers.given import Complaints
from observers.imbalance import Held, check_decision, largest, persist, threshold_of
from observers.path_inversion import CYLINDERS, INTERVAL, RADIANS

COEFFICIENTS = ("c_1_re", "c_1_im", "c_2_re", "c_2_im")


def make(
    scatter: Annotated[float, "rad2/s2"] = 0.0,
    relative_scatter: float = 0.05,
    false_alarm_rate: float = 1e-3,
    persistence: int = 1,
    firing_order: Sequence[int] = (1, 3, 4, 2),
    origin: Annotated[float, "rad"] = 0.0,
    window_end: Annotated[float, "rad"] = np.pi,
    sample_time: Annotated[float, "s"] = 0.0,
) -> Model:
    """V_i = sum of |c_k|^2 over k = -2..2 but 0, taken at the end of cylinder i's stroke, and V_i less the mean of all.

    Paper 004 (SAE 2006), Figure 12: c_k are the coefficients of the speed next to the cylinders over 180 deg, as an
    observer has them at `window_end` after the firing top dead centre of cylinder i, or at the first sampling after.
    c_-k is the conjugate of c_k, so V_i = 2 (|c_1|^2 + |c_2|^2).

    Once a cycle, after the stroke that comes last in `firing_order`, a verdict: without a fault each V_i varies by
    itself with the standard deviation f, f^2 = `scatter`^2 + (`relative_scatter` mean V)^2, and sum_i (V_i - mean V)^2
    over f^2 is chi-square of 3 degrees of freedom. The verdict is i where cylinder i is furthest above, -i where it is
    furthest below, and `amount` = sqrt(V_i/mean of the others) - 1, for V goes with the square of a torque. At speeds
    where the torque of the masses is larger than that of the gas the sign turns, which is not seen here.

    Raises ConfigurationError with all that is wrong with the arguments.
    """
    found = Complaints()
    for name, value in {"scatter": scatter, "relative_scatter": relative_scatter}.items():
        if not 0.0 <= value < np.inf:
            found.add(f"{name} wants 0 or more, got {value:g}")
    if scatter == 0.0 and relative_scatter == 0.0:
        found.add("scatter and relative_scatter want one above 0: without either every deviation is a fault")
    check_decision(firing_order, false_alarm_rate, persistence, sample_time, found)
    found.end()
    threshold = threshold_of(false_alarm_rate)
    return Model(
        name="torque_imbalance",
        description="Imbalance of four cylinders' torque from harmonics of the speed, stroke by stroke (SAE 2006)",
        role="observer",
        equations=lambda t, x, m, u, p: ({}, {"threshold": p.limit}),
        inputs=(
            *(Signal(name, "rad/s", 0.0, f"harmonic {name[2]} of the speed over 180 deg") for name in COEFFICIENTS),
            Signal("angle", "deg", 0.0, "crank angle, counted on", nominal=720.0),
        ),
        outputs=(Signal("threshold", "1", threshold, "what the statistic exceeds in a verdict"),),
        discrete=tuple(_signals()),
        parameters=(
            Signal("scatter", "rad2/s2", scatter, "standard deviation of V_i without a fault"),
            Signal("relative_scatter", "1", relative_scatter, "the same, as a share of the mean of V"),
            Signal("persistence", "1", float(persistence), "cycles in a row that move the verdict"),
            Signal("origin", "deg", origin / RADIANS, "firing top dead centre of the first cylinder in firing order"),
            Signal("window_end", "deg", window_end / RADIANS, "end of a stroke, after firing top dead centre"),
            Signal("limit", "1", threshold, "threshold of the statistic, chi-square of 3"),
            Signal("sample_time", "s", sample_time, "time from sampling to sampling, 0 at each step"),
        ),
        sample=_sampler(list(firing_order)),
        sample_time="sample_time",
    )


def variance_of(real: Sequence[Any], imaginary: Sequence[Any]) -> Any:
    """sum over k = -h..h but 0 of |c_k|^2 of a real signal, from c_1..c_h."""
    return 2.0 * sum(r**2 + i**2 for r, i in zip(real, imaginary, strict=True))


def _sampler(firing_order: Sequence[int]) -> Any:
    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        variance = variance_of([u.c_1_re, u.c_2_re], [u.c_1_im, u.c_2_im])
        moved = u.angle - m.last_angle
        # A step that goes back, or over a whole stroke, leaves strokes out: four new ones are wanted.
        whole = np.logical_and(m.begun > 0.5, np.logical_and(moved >= 0.0, moved < INTERVAL))
        ended = [
            np.logical_and(whole, passes(m.last_angle, u.angle, p.origin + p.window_end + INTERVAL * j))
            for j in range(CYLINDERS)
        ]
        values: dict[str, Any] = {
            f"V_{cylinder}": np.where(ended[j], variance, m[f"V_{cylinder}"]) for j, cylinder in enumerate(firing_order)
        }
        strokes: Any = m.strokes
        for one in ended:
            strokes = np.where(one, np.minimum(strokes + 1.0, float(CYLINDERS)), strokes)
        strokes = np.where(whole, strokes, 0.0)
        numbered = [values[f"V_{i}"] for i in range(1, CYLINDERS + 1)]
        mean = sum(numbered) / CYLINDERS
        known = strokes > CYLINDERS - 0.5
        balances = [np.where(known, value - mean, 0.0) for value in numbered]
        decided = np.logical_and(known, ended[-1])
        told = _told(balances, mean, m, p)
        return {
            **values,
            **{f"balance_{i}": value for i, value in enumerate(balances, start=1)},
            **{name: np.where(decided, value, m[name]) for name, value in told.items()},
            "strokes": strokes,
            "last_angle": u.angle,
            "begun": 1.0,
        }

    return sample


def _told(balances: Sequence[Any], mean: Any, m: Values, p: Values) -> dict[str, Any]:
    number, balance = largest(balances)
    spread = p.scatter**2 + (p.relative_scatter * mean) ** 2
    # Of a speed that does not vary at all there is nothing to tell.
    statistic = sum(value**2 for value in balances) / np.maximum(spread, 1e-30)
    faulty = statistic > p.limit
    said = np.where(faulty, np.where(balance > 0.0, number, -number), 0.0)
    held = persist(Held(m.verdict, m.candidate, m.count), said, p.persistence)
    own = np.maximum(mean + balance, 0.0)
    others = np.maximum(mean - balance / (CYLINDERS - 1), 1e-30)
    return {
        "verdict": held.verdict,
        "amount": np.where(faulty, np.sqrt(own / others) - 1.0, 0.0),
        "statistic": statistic,
        "cycles": m.cycles + 1.0,
        "candidate": held.candidate,
        "count": held.count,
    }


def _signals() -> list[Signal]:
    cylinders = range(1, CYLINDERS + 1)
    return [
        *(Signal(f"V_{i}", "rad2/s2", 0.0, f"variance of the speed at the end of cylinder {i}'s stroke")
          for i in cylinders),
        *(Signal(f"balance_{i}", "rad2/s2", 0.0, f"balance energy, V_{i} less the mean of all") for i in cylinders),
        Signal("verdict", "1", 0, "0 balanced, i cylinder i works more than the others, -i less", kind="integer"),
        Signal("amount", "1", 0.0, "relative torque error of the cylinder that deviates most, against the others"),
        Signal("statistic", "1", 0.0, "chi-square of the deviations"),
        Signal("cycles", "1", 0, "cycles that were diagnosed", kind="integer"),
        Signal("candidate", "1", 0.0, "what the last cycle said", local=True),
        Signal("count", "1", 0.0, "cycles in a row that said it", local=True),
        Signal("strokes", "1", 0.0, "strokes in a row that were seen, up to 4", local=True),
        Signal("last_angle", "deg", 0.0, "crank angle at the last sampling", local=True),
        Signal("begun", "1", 0.0, "1 once there was a sampling", local=True),
    ]  # fmt: skip
