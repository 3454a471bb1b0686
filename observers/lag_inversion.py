"""What drove a cascade of first-order lags, periodic in crank angle, from what its last one shows (Figure 2)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.model import Model, Values
from observers.given import Complaints, read_list, read_quantity
from observers.periodic import (
    Gains,
    PeriodicSystem,
    full_measurement_gains,
    input_row,
    sampled_error,
    variance_gain,
)
from observers.periodic_design import design, meet
from observers.periodic_input import LARGEST, MARGINAL
from observers.periodic_model import Frame, Stage, chain_model
from observers.periodic_schedule import GainLaw, certify, refined, schedule
from observers.periodic_settings import (
    DESIGN,
    READINGS,
    RPM,
    Setting,
    per_radian,
    read_choice,
    read_demand,
    read_gains,
    read_number,
    read_setting,
    read_start,
    require_stable,
)

Array = NDArray[np.float64]

# The paper's sensor: L~ = -4/tau and alpha_k^2 = 4/(k^2 + 1) [R]. What its L_k count per, the text leaves open.
DECAY, WEIGHT = 4.0, 4.0
KINDS = {"published": ("per",), "full": ("decay", "weight", "per"), "design": DESIGN}


class Lag(NamedTuple):
    """One lag: its time constant [s] from `low` to `high`, the same where it is known, and the input it comes from."""

    low: float
    high: float
    input: str = ""

    @property
    def varies(self) -> bool:
        """Whether the time constant is an input."""
        return bool(self.input)


def make(
    time_constants: Any,
    gains: dict[str, Any],
    period: str = "720 deg",
    harmonics: int = 3,
    step: str = "6 deg",
    speed: Any = "[600, 6000] rpm",
    nodes: int = 9,
    delay: str = "0 s",
    start: Any = None,
    unit: str = "1",
    allow_unstable: bool = False,
) -> Model:
    """One sampled observer a lag, tau x' = w - x, the one next to the sensor first; each feeds the next (Figure 2).

    `time_constants` from w to the sensor: `25 ms`, or `{input: tau_mixing, range: "[20, 80] ms"}` for one that is known
    while it runs. In omega tau the lag is dx/dalpha = (w - x)/(omega tau), so that gains over omega tau serve both.
    `gains` is one of `published: {per}`, `full: {decay, weight, per}`, L~ = -decay/tau and alpha_k^2 = weight/(k^2 + 1)
    (Eqs. 6 to 8), and `design: {multiplier, variance_gain, prefer}`. The multipliers of the cascade are those of all
    its stages together.

    Raises ConfigurationError with all that is wrong, as observers.periodic_input.make.
    """
    found = Complaints()
    setting = read_setting(period, harmonics, step, speed, nodes, found)
    lags = read_lags(time_constants, setting, found)
    waits = found.collect(read_quantity, delay, "s", "delay")
    begin = read_start(start, [unit], found)
    kind, raw = read_gains(gains, KINDS, found)
    found.end()
    assert waits is not None, "complaints were none"
    law, demanded = _law(kind, raw, lags, setting, found)
    found.end()
    assert law is not None, "complaints were none"
    stages: list[Stage] = []
    worst = 0.0
    for place in reversed(range(len(lags))):
        lag, name = lags[place], f"lag_inversion: lag {place + 1}"
        system = unit_lag(setting)
        gain, step_at = law(lag), _step(lag, setting)
        low, high = setting.low * lag.low, setting.high * lag.high
        scheduled = schedule(gain, low, high, setting.nodes)
        if demanded is not None:
            scheduled = refined(system, scheduled, gain, step_at, demanded)
        certificate = certify(system, scheduled, low, high, setting.nodes, step_at)
        require_stable(certificate, demanded, name, _told(lag), allow_unstable, found)
        worst = max(worst, certificate.worst[0])
        stages.append(Stage(system, scheduled, 1, _speed(lag, place), None if begin is None else (begin, begin)))
    found.end()
    varying = [(place, lag) for place, lag in enumerate(lags, start=1) if lag.varies]
    known = [(place, lag) for place, lag in enumerate(lags, start=1) if not lag.varies]
    frame = Frame(
        "lag_inversion",
        f"Periodic-input observers of {len(lags)} lags in a row",
        measured=(Signal("y", unit, 0.0, "what the last lag shows"),),
        reconstructed=(Signal("w", unit, 0.0, "what drives the first lag"),),
        low=setting.low, high=setting.high, multiplier=worst,
        variance_gain=_noise(lags, setting, [stage.schedule.gain for stage in stages]),
        delay=waits,
        inputs=tuple(
            Signal(lag.input, "s", float(np.sqrt(lag.low * lag.high)), f"time constant of lag {place}", lag.high)
            for place, lag in varying
        ),
        parameters=(
            *(Signal(f"tau_{j}", "s", g.low, f"time constant of lag {j}") for j, g in known),
            *(Signal(f"tau_{j}_low", "s", g.low, "least it was made for; less counts as that") for j, g in varying),
            *(Signal(f"tau_{j}_high", "s", g.high, "most it was made for; more counts as that") for j, g in varying),
        ),
    )  # fmt: skip
    return chain_model(frame, stages)


def unit_lag(setting: Setting) -> PeriodicSystem:
    """x' = w - x, which goes by sigma = omega tau."""
    one = np.eye(1)
    return PeriodicSystem(-one, one, one, setting.period, setting.harmonics)


def read_lags(raw: Any, setting: Setting, found: Complaints) -> list[Lag]:
    """The lags in the order given; complaints about what is no time constant."""
    items = raw
    if isinstance(raw, (str, int, float)):
        items = found.collect(read_list, raw, "s", "time_constants") or []
        lags = [Lag(value, value) for value in items]
    else:
        lags = [_read_lag(item, place, found) for place, item in enumerate(items or [], start=1)]
    if not lags and not found.messages:
        found.add("time_constants wants one time or more, like [25, 20] ms")
    for place, lag in enumerate(lags, start=1):
        if not 0.0 < lag.low <= lag.high < np.inf:
            found.add(f"time_constants: lag {place} wants times above 0 s, got {lag.low:g} s to {lag.high:g} s")
        if lag.varies and setting.sampling.per == "s":
            found.add(
                f"time_constants: lag {place}, an input, wants a step in crank angle, got {setting.sampling.step:g} s"
            )
    inputs = [lag.input for lag in lags if lag.varies]
    for name in inputs:
        if not name.isidentifier() or name in ("y", "angle", "omega") or inputs.count(name) > 1:
            found.add(f"time_constants wants inputs by names of their own, got {name}")
    return lags


def _read_lag(item: Any, place: int, found: Complaints) -> Lag:
    what = f"time_constants: lag {place}"
    if not isinstance(item, Mapping):
        value = found.collect(read_quantity, item, "s", what)
        return Lag(1.0, 1.0) if value is None else Lag(value, value)
    if set(item) != {"input", "range"}:
        found.add(f'{what} wants a time, or {{input: tau, range: "[20, 80] ms"}}; got {item}')
        return Lag(1.0, 1.0)
    values = found.collect(read_list, item["range"], "s", f"{what}: range") or [1.0]
    if len(values) != 2:
        found.add(f"{what}: range wants the least and the most, got {item['range']}")
    return Lag(values[0], values[-1], str(item["input"]))


def _law(
    kind: str, raw: Mapping[str, Any], lags: Sequence[Lag], setting: Setting, found: Complaints
) -> tuple[Callable[[Lag], GainLaw] | None, float | None]:
    """K over omega tau by lag, None where something is wrong; and the multiplier of a design."""
    if kind == "design":
        demand = read_demand(raw, found)
        system = unit_lag(setting)

        def designed(lag: Lag, multiplier: float) -> GainLaw:
            step = _step(lag, setting)
            return lambda sigma: design(system, sigma, step(sigma), multiplier)

        if found.messages:
            return None, None
        multiplier = found.collect(
            meet, demand, lambda mu: _noise(lags, setting, [designed(lag, mu) for lag in reversed(lags)])
        )
        if multiplier is None:
            return None, None
        return lambda lag: designed(lag, multiplier), multiplier
    # Those of `published` are those where none are given.
    decay = read_number(raw.get("decay", DECAY), "gains: full: decay", found, 0.0)
    weight = read_number(raw.get("weight", WEIGHT), "gains: full: weight", found, 0.0)
    word = read_choice(raw.get("per", "sample"), f"gains: {kind}: per", ("sample", "rad", "s"), found)
    if word == "s" and any(lag.varies for lag in lags):
        found.add(f"gains: {kind}: per wants sample or rad where a time constant is an input, got s")
    if found.messages:
        return None, None
    reading = next(one for one in READINGS if one == word)
    one = np.eye(1)
    weights = [weight / (k * k + 1) for k in range(setting.harmonics + 1)]
    # In units of tau: L = (decay - 1)/tau, L_k = alpha_k^2 (1/tau) (tau/(2 decay)).
    L, L_k = full_measurement_gains(-one, one, one, -decay * one, weights)

    def full(lag: Lag) -> GainLaw:
        step = _step(lag, setting)

        def gain(sigma: float) -> Array:
            unit = per_radian(reading, sigma / lag.low, step(sigma))
            per_rad = Gains(L / sigma, L_k.astype(complex)).times(1.0, unit)
            return per_rad.times(step(sigma), step(sigma)).stacked()

        return gain

    return full, None


def _step(lag: Lag, setting: Setting) -> Callable[[float], float]:
    """The step in crank angle [rad] at omega tau."""
    return lambda sigma: setting.sampling.angle(sigma / lag.low)


def _speed(lag: Lag, place: int) -> Callable[[Any, Values, Values], Any]:
    """omega tau at run time."""
    name = f"tau_{place + 1}"
    if not lag.varies:
        return lambda omega, u, p: omega * p[name]

    def sigma(omega: Any, u: Values, p: Values) -> Any:
        return omega * np.minimum(np.maximum(u[lag.input], p[f"{name}_low"]), p[f"{name}_high"])

    return sigma


def _told(lag: Lag) -> Callable[[float], str]:
    if lag.varies:
        return lambda sigma: f"omega tau = {sigma:.6g} rad"
    return lambda sigma: f"{sigma / lag.low / RPM:.6g} rpm"


def _noise(lags: Sequence[Lag], setting: Setting, laws: Sequence[Callable[[float], Array]]) -> float:
    """Largest variance gain of the cascade over nodes and ends of time constants; the first of `laws` is next to y."""
    system, worst = unit_lag(setting), 0.0
    row = input_row(system)
    for omega in setting.speeds:
        step = setting.sampling.angle(omega)
        for taus in itertools.product(*(sorted({lag.low, lag.high}) for lag in reversed(lags))):
            maps = []
            for tau, law in zip(taus, laws, strict=True):
                K = law(omega * tau)
                maps.append((sampled_error(system, K, omega * tau, step), K, row))
            if not max(np.abs(np.linalg.eigvals(moved)).max() for moved, _, _ in maps) < MARGINAL:
                return LARGEST
            worst = max(worst, float(variance_gain(maps).max()))
    return worst
