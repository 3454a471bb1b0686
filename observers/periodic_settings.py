"""What periodic-input observers are given as a campaign writes it: period, sampling, speeds, and what is wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.model import ModelError, unknown
from observers.given import Complaints, read_list, read_quantity
from observers.periodic import PeriodicSystem, unseen_harmonics
from observers.periodic_design import Demand
from observers.periodic_schedule import NEAR, Certificate, Sampling

Array = NDArray[np.float64]
Reading = Literal["s", "sample", "rad"]
READINGS: tuple[Reading, ...] = ("s", "sample", "rad")

# How near to a whole number of steps a period of crank angle has to be, relatively.
WHOLE = 1e-9
RPM = np.pi / 30.0  # rad/s


class Setting(NamedTuple):
    """Period [rad], harmonics, sampling, lowest and highest speed [rad/s], how many speeds are nodes."""

    period: float
    harmonics: int
    sampling: Sampling
    low: float
    high: float
    nodes: int

    @property
    def speeds(self) -> Array:
        """The nodes [rad/s]."""
        return np.array([self.low]) if self.low == self.high else np.geomspace(self.low, self.high, self.nodes)


def read_setting(period: Any, harmonics: Any, step: Any, speed: Any, nodes: Any, found: Complaints) -> Setting:
    """The setting; where something is wrong it is left with `found`, and the setting is of no use.

    Refused: no crank angle, a period that is not a whole number of steps in crank angle, and fewer than 2h + 1 samples
    in a period at the highest speed: then two harmonics look alike (aliasing).
    """
    turn = found.collect(read_quantity, period, "rad", "period")
    if turn is not None and not turn > 0.0:
        found.add(f"period wants a crank angle above 0, got {period}")
    if not isinstance(harmonics, int) or isinstance(harmonics, bool) or harmonics < 0:
        found.add(f"harmonics wants a whole number, 0 or more, got {harmonics}")
    if not isinstance(nodes, int) or isinstance(nodes, bool) or nodes < 3:
        found.add(f"nodes wants a whole number, 3 or more, got {nodes}")
    sampling = read_sampling(step, found)
    speeds = found.collect(read_list, speed, "rad/s", "speed") or [1.0]
    if len(speeds) > 2 or not 0.0 < speeds[0] <= speeds[-1]:
        found.add(f"speed wants the lowest and the highest speed, above 0, like [600, 6000] rpm; got {speed}")
    if found.messages or turn is None or sampling is None:
        return Setting(1.0, 0, Sampling(0.1, "rad"), 1.0, 1.0, 3)
    setting = Setting(turn, harmonics, sampling, speeds[0], speeds[-1], nodes)
    samples = turn / sampling.angle(setting.high)
    if sampling.per == "rad" and abs(samples - round(samples)) > WHOLE * samples:
        found.add(
            f"period wants a whole number of steps, got {np.degrees(turn):.6g} deg in steps of "
            f"{np.degrees(sampling.step):.6g} deg, {samples:.6g} of them"
        )
    elif samples < (2 * harmonics + 1) * (1.0 - WHOLE):
        most = int((samples + WHOLE - 1.0) // 2)
        at = "" if sampling.per == "rad" else f" at {setting.high / RPM:.6g} rpm"
        found.add(
            f"harmonics wants {most} or fewer: {harmonics} harmonics want {2 * harmonics + 1} samples in a period, "
            f"and{at} there are {samples:.6g}; sample more often, or take fewer (aliasing)"
        )
    return setting


def read_sampling(raw: Any, found: Complaints) -> Sampling | None:
    """A step in crank angle or time; None where it is none of them."""
    for unit in ("rad", "s"):
        try:
            step = read_quantity(raw, unit, "step")
        except ModelError:
            continue
        if step > 0.0:
            return Sampling(step, "rad" if unit == "rad" else "s")
    found.add(f"step wants a crank angle or a time above 0, like 6 deg or 1 ms; got {raw}")
    return None


def read_start(raw: Any, units: list[str], found: Complaints) -> Array | None:
    """w at the start (m,); None where the observer is to begin with what it first measures."""
    if raw is None:
        return None
    values = found.collect(read_list, raw, units[0], "start") or [0.0] * len(units)
    if len(values) != len(units):
        found.add(f"start wants one value an input, {len(units)}, got {raw}")
        return None
    return np.array(values)


def per_radian(reading: Reading, omega: float, step: float) -> float:
    """What turns a gain per s, sample or rad into one per rad, at `omega` [rad/s] and `step` [rad]."""
    return {"s": 1.0 / omega, "sample": 1.0 / step, "rad": 1.0}[reading]


def read_choice(raw: Any, name: str, known: tuple[str, ...], found: Complaints) -> str:
    """One of the words; the first one where it is none, which is then left with `found`."""
    if raw in known:
        return str(raw)
    found.add(f"{name}: {unknown(str(raw), known, 'choice')}; there are {', '.join(known)}")
    return known[0]


def read_gains(gains: Any, kinds: Mapping[str, tuple[str, ...]], found: Complaints) -> tuple[str, dict[str, Any]]:
    """The one kind of gains that is asked for, and what is said of it; `kinds` gives each kind's keys."""
    if isinstance(gains, Mapping) and len(gains) == 1:
        kind, raw = next(iter(gains.items()))
        if kind in kinds:
            if not isinstance(raw, Mapping):
                found.add(f"gains: {kind} wants a mapping of {', '.join(kinds[kind])}; got {raw}")
                return kind, {}
            for key in raw:
                if key not in kinds[kind]:
                    found.add(f"gains: {kind}: {unknown(key, kinds[kind], 'key')}")
            return kind, dict(raw)
        found.add(f"gains: {unknown(str(kind), kinds, 'kind')}; there are {', '.join(kinds)}")
    else:
        found.add(f"gains wants one of {', '.join(kinds)}, like {{design: {{multiplier: 0.3}}}}; got {gains}")
    return "", {}


DESIGN = ("multiplier", "variance_gain", "prefer")


def read_demand(raw: Mapping[str, Any], found: Complaints) -> Demand:
    """The demand of `design`; whether it can be met is told by observers.periodic_design.meet."""
    values: dict[str, float | None] = {}
    for key in ("multiplier", "variance_gain"):
        values[key] = None if raw.get(key) is None else found.collect(read_quantity, raw[key], "1", f"design: {key}")
    prefer = read_choice(raw.get("prefer", "noise"), "design: prefer", ("noise", "convergence"), found)
    return Demand(values["multiplier"], values["variance_gain"], "noise" if prefer == "noise" else "convergence")


def read_number(raw: Any, name: str, found: Complaints, least: float = -np.inf) -> float:
    """A plain number above `least`; 1 where it is none, which is then left with `found`."""
    value = found.collect(read_quantity, raw, "1", name)
    if value is None:
        return 1.0
    if not value > least:
        found.add(f"{name} wants a value above {least:g}, got {raw}")
        return 1.0
    return value


def require_seen(
    system: PeriodicSystem, speeds: list[float], name: str, told: Callable[[float], str], found: Complaints
) -> None:
    """A complaint for each harmonic that y does not see at one of the speeds."""
    for sigma in speeds:
        missing = unseen_harmonics(system, sigma)
        for k, reason in missing:
            found.add(f"{name}: harmonic k = {k} of the input is not observable at {told(sigma)}: {reason}")
        if missing:
            return


def require_stable(
    certificate: Certificate,
    demanded: float | None,
    name: str,
    told: Callable[[float], str],
    allowed: bool,
    found: Complaints,
) -> None:
    """A complaint where a multiplier is beyond what was demanded, or 1 or more unless that is allowed."""
    worst, sigma = certificate.worst
    if demanded is not None and worst > demanded * (1.0 + 2.0 * NEAR):
        found.add(
            f"{name}: the demanded multiplier of {demanded:.6g} is {worst:.6g} between the nodes at {told(sigma)}, and "
            "more of them do not help; give a narrower range of speeds"
        )
    if not worst < 1.0 and not allowed:
        found.add(
            f"{name}: the gains do not converge: at {told(sigma)} the largest Floquet multiplier over a period is "
            f"{worst:.6g}, and below 1 is wanted; choose others, or give `allow_unstable: true` to see it"
        )
