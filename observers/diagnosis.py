"""Which cylinder has too much fuel or too little: the diagnosis of an AFR signal, engine cycle by engine cycle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np

from fmus.component import Signal
from fmus.crankcycle import CYCLE
from fmus.model import Model, Values, unknown
from observers.cycle_spectrum import HARMONICS, Sample, Spectrum, Sums, Windows, add_step, sums_signals
from observers.given import Complaints
from observers.imbalance import (
    Held,
    Variances,
    check_decision,
    fuel_error,
    largest,
    pair_of,
    persist,
    statistic_of,
    threshold_of,
    variances_of_harmonic_means,
    variances_of_means,
    variances_of_path,
)
from observers.path_inversion import (
    CYLINDERS,
    INTERVAL,
    RADIANS,
    RAISED_COSINE,
    Path,
    Pattern,
    Phasor,
    conditioning,
    deviations_of,
    locate,
    noise_sizes,
    path_phasors,
    pattern_of,
)


class Estimate(NamedTuple):
    """The deviations of the cylinders in firing order, as a pattern, and what they vary without a fault."""

    pattern: Pattern
    variances: Variances
    conditioning: Any


def make(
    estimate: str = "path",
    noise: float = 0.0,
    scatter: float = 0.1,
    false_alarm_rate: float = 1e-3,
    persistence: int = 1,
    firing_order: Sequence[int] = (1, 3, 4, 2),
    origin: Annotated[float, "rad"] = 0.0,
    evo: Annotated[float, "rad"] = 135.0 * RADIANS,
    evc: Annotated[float, "rad"] = 375.0 * RADIANS,
    pulse: Annotated[float | None, "rad"] = None,
    centre: Annotated[float | None, "rad"] = None,
    mixing_time: Annotated[float, "s"] = 0.0,
    mixing_angle: Annotated[float, "rad"] = 0.0,
    delay_time: Annotated[float, "s"] = 0.0,
    delay_angle: Annotated[float, "rad"] = 0.0,
    cells: int = 0,
    lags: Annotated[Sequence[float] | float, "s"] = (),
    inverted: Annotated[Sequence[float] | float, "s"] = (),
    memory: float = 1.0,
    longest_step: Annotated[float, "rad"] = 60.0 * RADIANS,
    sample_time: Annotated[float, "s"] = 0.0,
) -> Model:
    """At the end of each cycle: means over exhaust phases, harmonics, each cylinder's deviation, a verdict.

    Paper 004 (SAE 2006), From oscillations to imbalance diagnosis: `mean_i` is the mean of w from `evo` to `evc` after
    cylinder i's firing top dead centre, `E_k` = sqrt(|c_k|^2 + |c_-k|^2). `estimate` is what the decision rests on:
    `exhaust_mean`, those means less their mean; or `path`, what `observers.path_inversion.locate` makes of c_1..c_3, of
    `pulse`, `centre`, `mixing_*`, `delay_*`, `cells` and `lags` as in `observers.path_inversion.Path`. Where `centre`
    and `pulse` are absent they are those of a raised cosine from `evo` to `evc`.

    `inverted` are lags that an observer has taken off w, and `memory` the variance that it leaves a coefficient over
    that of one cycle's samples: with them `noise` is that of the sensor, and harmonics count by their noise. `noise` is
    the standard deviation of white noise on w, `scatter` that of each cylinder's own AFR from cycle to cycle or, where
    the noise is not white, of the deviations themselves; both in the unit of w. The verdict is on where the chi-square
    statistic of the deviations exceeds what it exceeds with `false_alarm_rate` in a cycle without a fault, for
    `persistence` cycles in a row. The cylinder in first place of `firing_order` fires at `origin`.

    Raises ConfigurationError with all that is wrong with the arguments.
    """
    found = Complaints()
    lags, inverted = ((one,) if isinstance(one, (int, float)) else tuple(one) for one in (lags, inverted))
    estimators = {"path": _by_path(cells), "exhaust_mean": _by_harmonic_means if inverted else _by_means}
    if estimate not in estimators:
        found.add(f"estimate: {unknown(str(estimate), estimators, 'estimate')}")
    check_decision(firing_order, false_alarm_rate, persistence, sample_time, found)
    opens, closes, longest = evo / RADIANS, evc / RADIANS, longest_step / RADIANS  # deg, as all angles in the model
    if not 0.0 < closes - opens < 360.0:
        told = "evc wants to come after evo, by less than 360 deg, over which means of opposite cylinders see the same"
        found.add(f"{told}; got {opens:g} to {closes:g} deg")
    even = RAISED_COSINE * (closes - opens) if pulse is None else pulse / RADIANS
    if not 0.0 < even < 360.0:
        found.add(f"pulse wants more than 0 and less than 360 deg, where nothing is left of c_2, got {even:g} deg")
    named = {"mixing_time": mixing_time, "mixing_angle": mixing_angle, "delay_time": delay_time}
    rows = {"lags": lags, "inverted": inverted}
    taus = {f"{name}[{i}]": tau for name, row in rows.items() for i, tau in enumerate(row, start=1)}
    for name, value in {**named, "delay_angle": delay_angle, **taus, "noise": noise, "scatter": scatter}.items():
        if not 0.0 <= value < np.inf:
            found.add(f"{name} wants 0 or more, got {value:g}")
    if not 0.0 < memory < np.inf:
        found.add(f"memory wants more than 0, got {memory:g}")
    if cells < 0:
        found.add(f"cells wants 0, a true delay, or more, got {cells}")
    if noise == 0.0 and scatter == 0.0:
        found.add("noise and scatter want one above 0: without either every deviation is a fault")
    # The harmonics of a cycle want seven samples at least.
    if not 0.0 < longest <= 90.0:
        found.add(f"longest_step wants more than 0 deg and 90 deg at most, got {longest:g} deg")
    found.end()
    middle = (opens + closes) / 2.0 if centre is None else centre / RADIANS
    return _model(
        estimators[estimate],
        list(firing_order),
        threshold_of(false_alarm_rate),
        (
            Signal("noise", "1", noise, "standard deviation of white noise on w, in its unit"),
            Signal("scatter", "1", scatter, "standard deviation of each cylinder's AFR without a fault"),
            Signal("persistence", "1", float(persistence), "cycles in a row that move the verdict"),
            Signal("origin", "deg", origin / RADIANS, "firing top dead centre of the first cylinder in firing order"),
            Signal("evo", "deg", opens, "exhaust valve opens, after firing top dead centre"),
            Signal("evc", "deg", closes, "exhaust valve closes, after firing top dead centre"),
            Signal("pulse", "deg", even, "over which a cylinder's charge passes"),
            Signal("centre", "deg", middle, "middle of the pulse, after firing top dead centre"),
            Signal("mixing_time", "s", mixing_time, "mixing of the manifold, what is fixed in time"),
            Signal(
                "mixing_angle", "deg", mixing_angle / RADIANS, "mixing of the manifold, what is fixed in crank angle"
            ),
            Signal("delay_time", "s", delay_time, "transport, what is fixed in time"),
            Signal("delay_angle", "deg", delay_angle / RADIANS, "transport, what is fixed in crank angle"),
            Signal("lags", "s", lags or (0.0,), "first-order lags of the sensor", shape=(len(lags) or 1,)),
            Signal("inverted", "s", inverted or (0.0,), "lags taken off w by an observer", shape=(len(inverted) or 1,)),
            Signal("memory", "1", memory, "variance of a coefficient over that of one cycle's samples"),
            Signal("longest_step", "deg", longest, "a cycle with a longer step does not count"),
            Signal("sample_time", "s", sample_time, "time from sampling to sampling, 0 at each step"),
        ),
    )


def _by_path(cells: int) -> Callable[[Spectrum, Values], Estimate]:
    def estimate(spectrum: Spectrum, p: Values) -> Estimate:
        path = Path(p.centre, p.pulse, p.mixing_time, p.mixing_angle, p.delay_time, p.delay_angle, list(p.lags), cells)
        phasors = path_phasors(path, spectrum.omega)
        sizes = noise_sizes(list(p.inverted), p.memory, spectrum.omega)
        phasors = [Phasor(g.size / size, g.angle) for g, size in zip(phasors, sizes, strict=True)]
        real, imaginary = (
            [c / size for c, size in zip(part[1:], sizes, strict=True)] for part in (spectrum.real, spectrum.imaginary)
        )
        pattern = locate(real, imaginary, phasors)
        variances = variances_of_path(phasors, p.noise, spectrum.share, p.scatter)
        return Estimate(pattern, variances, conditioning(phasors))

    return estimate


def _by_means(spectrum: Spectrum, p: Values) -> Estimate:
    variances = variances_of_means(p.evc - p.evo, p.noise, CYCLE * spectrum.share, p.scatter)
    return Estimate(pattern_of(spectrum.means), variances, 1.0)


def _by_harmonic_means(spectrum: Spectrum, p: Values) -> Estimate:
    sizes = noise_sizes(list(p.inverted), p.memory, spectrum.omega)
    coefficients = [p.noise**2 * spectrum.share * size**2 for size in sizes]
    variances = variances_of_harmonic_means(p.evc - p.evo, coefficients, p.scatter)
    return Estimate(pattern_of(spectrum.means), variances, 1.0)


def _model(
    estimator: Callable[[Spectrum, Values], Estimate],
    firing_order: Sequence[int],
    threshold: float,
    parameters: tuple[Signal, ...],
) -> Model:
    places = [firing_order.index(cylinder) for cylinder in range(1, CYLINDERS + 1)]

    def sample(t: Any, x: Values, m: Values, u: Values, p: Values) -> dict[str, Any]:
        new = Sample(u.angle, u.w, u.omega)
        # Of the first sample there is nothing before: a step of no length.
        old = Sample(*(np.where(m.begun > 0.5, m[f"last_{name}"], getattr(new, name)) for name in Sample._fields))
        opens = p.origin + p.evo
        begins = [opens + INTERVAL * j - CYCLE * np.floor((opens + INTERVAL * j - p.origin) / CYCLE) - p.origin
                  for j in range(CYLINDERS)]  # fmt: skip
        sums = Sums(*(m[f"sum_{name}"] for name in Sums._fields))
        kept, whole, spectrum = add_step(sums, old, new, Windows(begins, p.evc - p.evo), p.origin, p.longest_step)
        told = _told(estimator(spectrum, p), spectrum, m, p)
        return {
            **{name: np.where(whole, value, m[name]) for name, value in told.items()},
            **{f"sum_{name}": value for name, value in kept._asdict().items()},
            **{f"last_{name}": value for name, value in new._asdict().items()},
            "begun": 1.0,
        }

    def _told(estimate: Estimate, spectrum: Spectrum, m: Values, p: Values) -> dict[str, Any]:
        by_place = deviations_of(estimate.pattern)
        deviations = [by_place[place] for place in places]
        number, deviation = largest(deviations)
        statistic = statistic_of(estimate.pattern, estimate.variances)
        faulty = statistic > p.limit
        # Too much fuel is a low AFR.
        said = np.where(faulty, np.where(deviation < 0.0, number, -number), 0.0)
        held = persist(Held(m.verdict, m.candidate, m.count), said, p.persistence)
        energies = [r**2 + i**2 for r, i in zip(spectrum.real, spectrum.imaginary, strict=True)]
        return {
            **{f"mean_{i}": spectrum.means[place] for i, place in enumerate(places, start=1)},
            **{f"deviation_{i}": value for i, value in enumerate(deviations, start=1)},
            "c_0": spectrum.real[0],
            **{f"c_{k}_re": spectrum.real[k] for k in range(1, HARMONICS + 1)},
            **{f"c_{k}_im": spectrum.imaginary[k] for k in range(1, HARMONICS + 1)},
            **{f"E_{k}": np.sqrt(2.0 * energies[k]) for k in range(1, HARMONICS + 1)},
            "balance_energy": 2.0 * sum(energies[1:]),
            "verdict": held.verdict,
            "amount": np.where(faulty, fuel_error(deviation, spectrum.real[0]), 0.0),
            "pair": np.where(faulty, -pair_of(estimate.pattern, estimate.variances), 0.0),
            "statistic": statistic,
            "conditioning": estimate.conditioning,
            "cycles": m.cycles + 1.0,
            "candidate": held.candidate,
            "count": held.count,
        }

    return Model(
        name="diagnosis",
        description="Imbalance of four cylinders from an AFR signal, cycle by cycle (SAE 2006)",
        role="observer",
        equations=lambda t, x, m, u, p: ({}, {"threshold": p.limit}),
        inputs=(
            Signal("w", "1", 0.0, "air-fuel ratio that a sensor shows or an observer reconstructs", nominal=20.0),
            Signal("angle", "deg", 0.0, "crank angle, counted on", nominal=720.0),
            Signal("omega", "rad/s", 100.0, "engine speed", nominal=100.0),
        ),
        outputs=(Signal("threshold", "1", threshold, "what the statistic exceeds in a verdict"),),
        discrete=(*_told_signals(), *sums_signals(CYLINDERS), *_last_signals()),
        parameters=(*parameters, Signal("limit", "1", threshold, "threshold of the statistic, chi-square of 3")),
        sample=sample,
        sample_time="sample_time",
    )


def _told_signals() -> list[Signal]:
    cylinders, harmonics = range(1, CYLINDERS + 1), range(1, HARMONICS + 1)
    return [
        *(Signal(f"mean_{i}", "1", 0.0, f"mean of w over the exhaust phase of cylinder {i}") for i in cylinders),
        *(Signal(f"deviation_{i}", "1", 0.0, f"AFR of cylinder {i} less the mean of all") for i in cylinders),
        Signal("c_0", "1", 0.0, "mean of w over the cycle"),
        *(Signal(f"c_{k}_re", "1", 0.0, f"real part of harmonic {k} of the cycle") for k in harmonics),
        *(Signal(f"c_{k}_im", "1", 0.0, f"imaginary part of harmonic {k}") for k in harmonics),
        *(Signal(f"E_{k}", "1", 0.0, f"energy of harmonic {k}, sqrt(|c_k|^2 + |c_-k|^2)") for k in harmonics),
        Signal("balance_energy", "1", 0.0, "sum over k = -3..3 but 0 of |c_k|^2"),
        Signal("verdict", "1", 0, "0 balanced, i cylinder i has too much fuel, -i too little", kind="integer"),
        Signal("amount", "1", 0.0, "relative fuel error of the cylinder that deviates most, against the others"),
        Signal("pair", "1", 0, "1 first and third in firing order have more than the others, -1 less", kind="integer"),
        Signal("statistic", "1", 0.0, "chi-square of the deviations"),
        Signal("conditioning", "1", 1.0, "condition number of the map from deviations to harmonics"),
        Signal("cycles", "1", 0, "whole cycles that were diagnosed", kind="integer"),
        Signal("candidate", "1", 0.0, "what the last cycle said", local=True),
        Signal("count", "1", 0.0, "cycles in a row that said it", local=True),
    ]


def _last_signals() -> list[Signal]:
    return [
        Signal("last_angle", "deg", 0.0, "crank angle at the last sampling", local=True),
        Signal("last_w", "1", 0.0, "w then", local=True),
        Signal("last_omega", "rad/s", 0.0, "engine speed then", local=True),
        Signal("begun", "1", 0.0, "1 once there was a sampling", local=True),
    ]
