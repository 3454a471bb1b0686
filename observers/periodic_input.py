"""The periodic input of any linear system from its outputs: x' = A x + A0 w, y = C x, w of h harmonics of T0."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fmus.component import Signal
from fmus.model import Model
from observers.given import Complaints, read_quantity
from observers.periodic import (
    Gains,
    PeriodicSystem,
    full_measurement_gains,
    input_row,
    partial_measurement_gains,
    sampled_error,
    variance_gain,
)
from observers.periodic_design import design, meet
from observers.periodic_model import NOTHING, Extra, Frame, Stage, chain_model, parts_of
from observers.periodic_response import check_resolved
from observers.periodic_schedule import GainLaw, Sampling, Schedule, certify, refined, schedule
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
    require_seen,
    require_stable,
)
from observers.periodic_told import endings

Array = NDArray[np.float64]

LARGEST = float(np.finfo(float).max)  # what stands for no bound in an output, which has to be finite
# Largest modulus of a sampled eigenvalue at which the noise is still computed; beyond, rounding decides.
MARGINAL = 1.0 - 1e-9

KINDS = {
    "full": ("L_tilde", "alpha_squared", "per"),
    "partial": ("L", "epsilon", "sign", "per"),
    "design": (*DESIGN, "noise"),
}


def make(
    A: Any,
    A0: Any,
    C: Any,
    gains: dict[str, Any],
    period: str = "720 deg",
    harmonics: int = 3,
    step: str = "6 deg",
    speed: Any = "[600, 6000] rpm",
    per: str = "s",
    nodes: int = 9,
    delay: str = "0 s",
    start: Any = None,
    units: dict[str, Any] | None = None,
    allow_unstable: bool = False,
) -> Model:
    """The sampled observer of docs/periodic.md for matrices A (n, n), A0 (n, m), C (p, n) that count `per` s or rad.

    `gains` is one of
    - `full: {L_tilde, alpha_squared, per}`, Eqs. 6 to 8; L_tilde counts as A does, L_k `per` s, sample or rad;
    - `partial: {L, epsilon, sign, per}`, Eq. 9; `sign` minus is as printed, plus is what descends;
    - `design: {multiplier, variance_gain, prefer, noise}`, observers.periodic_design.

    Certified at `nodes` speeds and between them for samplings every `step`. `delay` is the transport before the system,
    `units` those of `y` and `w`, `start` the w that it begins at rest with.

    Raises ConfigurationError with all that is wrong: shapes, A0 or C not injective, aliasing, a harmonic that y does
    not see, a demand that cannot be met, multipliers of 1 or more in the range without `allow_unstable`.
    """
    found = Complaints()
    setting = read_setting(period, harmonics, step, speed, nodes, found)
    word = read_choice(per, "per", ("s", "rad"), found)
    system = read_system(A, A0, C, setting, word, found)
    found.end()
    return system_model(
        "periodic_input",
        f"Observer of a periodic input of {setting.harmonics} harmonics",
        system, setting, gains, delay, start, units, allow_unstable,
    )  # fmt: skip


def read_system(A: Any, A0: Any, C: Any, setting: Setting, per: str, found: Complaints) -> PeriodicSystem:
    """The matrices; complaints where shapes do not fit, or A0 or C' map something to nothing (Hypothesis 1)."""
    matrices = {}
    for name, raw in (("A", A), ("A0", A0), ("C", C)):
        try:
            matrices[name] = np.atleast_2d(np.array(raw, dtype=float))
        except (TypeError, ValueError):
            found.add(f"{name} wants rows of numbers, like [[0, 1], [-4, -1]]; got {raw}")
            matrices[name] = np.eye(1)
    n = len(matrices["A"])
    wanted = {"A": f"({n}, {n})", "A0": f"({n}, m)", "C": f"(p, {n})"}
    fits = {"A": (n, n), "A0": (n, matrices["A0"].shape[-1]), "C": (len(matrices["C"]), n)}
    for name, matrix in matrices.items():
        if matrix.shape != fits[name] or not np.isfinite(matrix).all():
            found.add(f"{name} wants the shape {wanted[name]} and finite numbers, got {matrix.shape}")
    if not found.messages:
        m, p = matrices["A0"].shape[1], len(matrices["C"])
        if not m <= p <= n:
            found.add(f"wants inputs <= outputs <= states, got A0 with {m}, C with {p}, A with {n}")
        for name, matrix, size in (("A0", matrices["A0"], m), ("C", matrices["C"].T, p)):
            rank = int(np.linalg.matrix_rank(matrix))
            if rank < size:
                told = "columns" if name == "A0" else "rows"
                found.add(f"{name} wants independent {told} (Hypothesis 1), got the rank {rank} of {size}")
    return PeriodicSystem(
        matrices["A"], matrices["A0"], matrices["C"], setting.period, setting.harmonics, "s" if per == "s" else "rad"
    )


def told(omega: float) -> str:
    """A speed [rad/s] in words."""
    return f"{omega / RPM:.6g} rpm"


def system_model(
    name: str,
    description: str,
    system: PeriodicSystem,
    setting: Setting,
    gains: Any,
    delay: Any,
    start: Any,
    units: dict[str, Any] | None,
    allow_unstable: bool,
    law: GainLaw | None = None,
    extra: Extra = NOTHING,
) -> Model:
    """The model of one stage; `law` gives the gains where a module has its own way to them.

    Raises ConfigurationError with all that is wrong.
    """
    found = Complaints()
    ends = sorted({setting.low, setting.high})
    given = {"y": "1", "w": "1"} | dict(units or {})
    for key in set(given) - {"y", "w"}:
        found.add(f"units wants y and w, got {key}")
    m, p = system.A0.shape[1], len(system.C)
    waits = found.collect(read_quantity, delay, "s", "delay")
    begin = read_start(start, [str(given["w"])] * m, found)
    require_seen(system, ends, name, told, found)
    found.end()
    found.collect(check_resolved, system, ends)
    parts = found.collect(
        parts_of, system, setting.sampling.angle(setting.low) / (setting.low if system.per == "s" else 1.0)
    )
    if setting.sampling.per == "s" and system.per == "rad":
        parts = found.collect(parts_of, system, setting.sampling.angle(setting.high))
    chosen, demanded = (law, None) if law else read_law(system, setting, gains, found)
    found.end()
    assert chosen is not None and waits is not None and parts is not None, "complaints were none"
    scheduled = found.collect(schedule, chosen, setting.low, setting.high, setting.nodes)
    found.end()
    assert scheduled is not None, "complaints were none"
    if demanded is not None:
        scheduled = refined(system, scheduled, chosen, setting.sampling.angle, demanded)
    certificate = certify(system, scheduled, setting.low, setting.high, setting.nodes, setting.sampling.angle)
    require_stable(certificate, demanded, name, told, allow_unstable, found)
    found.end()
    at_rest = None if begin is None else (-np.linalg.solve(system.A, system.A0) @ begin, begin)
    frame = Frame(
        name, description,
        measured=tuple(Signal(f"y{end}", given["y"], 0.0, "measured") for end in endings(p)),
        reconstructed=tuple(Signal(f"w{end}", given["w"], 0.0, "reconstructed input") for end in endings(m)),
        low=setting.low, high=setting.high, multiplier=certificate.worst[0],
        variance_gain=noise_gain(system, scheduled, setting.sampling, certificate.speeds), delay=waits,
    )  # fmt: skip
    stage = Stage(system, scheduled, parts, lambda omega, u, p: omega, at_rest)
    return chain_model(frame, [stage], extra)


def noise_gain(system: PeriodicSystem, scheduled: Schedule, sampling: Sampling, speeds: Array) -> float:
    """Largest variance of a w by that of white noise on y, of all speeds; LARGEST where the observer is unstable."""
    worst = 0.0
    for omega in speeds:
        K = scheduled.gain(omega)
        moved = sampled_error(system, K, omega, sampling.angle(omega))
        if not np.abs(np.linalg.eigvals(moved)).max() < MARGINAL:
            return LARGEST
        worst = max(worst, float(variance_gain([(moved, K, input_row(system))]).max()))
    return worst


def read_law(
    system: PeriodicSystem, setting: Setting, gains: Any, found: Complaints
) -> tuple[GainLaw | None, float | None]:
    """K over the speed for what is asked in `gains`, None where something is wrong; and the multiplier of a design."""
    before = len(found.messages)
    kind, raw = read_gains(gains, KINDS, found)
    if kind == "design":
        return design_law(system, setting, raw, found)
    if not kind:
        return None, None
    n, p = len(system.A), len(system.C)
    shape = (n, n) if kind == "full" else (n, p)
    key = "L_tilde" if kind == "full" else "L"
    try:
        state = np.array(raw.get(key), dtype=float).reshape(shape)
    except (TypeError, ValueError):
        found.add(f"gains: {kind}: {key} wants the shape {shape}, got {raw.get(key)}")
        return None, None
    word = read_choice(raw.get("per", "rad"), f"gains: {kind}: per", READINGS, found)
    reading = next(one for one in READINGS if one == word)
    weights: Array
    if kind == "full":
        weights = np.array(raw.get("alpha_squared", []), dtype=float)
        if weights.shape != (setting.harmonics + 1,) or not (weights > 0.0).all():
            found.add(
                f"gains: full: alpha_squared wants {setting.harmonics + 1} values above 0, one for k = 0 to "
                f"{setting.harmonics}; got {raw.get('alpha_squared')}"
            )
        if p != n:
            found.add(f"gains: full wants as many outputs as states, {n}, got {p}; `partial` and `design` do not")
        elif not np.linalg.eigvals(state).real.max() < 0.0:
            found.add(f"gains: full: L_tilde wants eigenvalues in the left half-plane, got {raw[key]}")
    epsilon = read_number(raw.get("epsilon"), "gains: partial: epsilon", found, 0.0) if kind == "partial" else 0.0
    sign = read_choice(raw.get("sign", "plus"), "gains: partial: sign", ("plus", "minus"), found)
    if len(found.messages) > before:
        return None, None

    def law(omega: float) -> Array:
        step = setting.sampling.angle(omega)
        over = omega if system.per == "s" else 1.0
        A, A0 = system.rates(omega)
        if kind == "full":
            L, real = full_measurement_gains(A, A0, system.C, state / over, weights.tolist())
            L_k = real.astype(np.complex128)
        else:
            L = state / over
            orders = [k * system.order for k in range(system.harmonics + 1)]
            L_k = partial_measurement_gains(A, A0, system.C, L, orders, epsilon, "plus" if sign == "plus" else "minus")
        unit = per_radian(reading, omega, step)
        return Gains(L, L_k).times(step, unit * step).stacked()

    return law, None


def design_law(
    system: PeriodicSystem, setting: Setting, raw: dict[str, Any], found: Complaints
) -> tuple[GainLaw | None, float | None]:
    """K over the speed by observers.periodic_design and its multiplier, one for the whole range; None where none is."""
    before = len(found.messages)
    demand = read_demand(raw, found)
    noise = None
    if raw.get("noise") is not None:
        noise = np.atleast_1d(np.array(raw["noise"], dtype=float))
        if noise.shape != (len(system.C),) or not (noise > 0.0).all():
            found.add(f"gains: design: noise wants {len(system.C)} standard deviations above 0, got {raw['noise']}")
    if len(found.messages) > before:
        return None, None

    def gain(omega: float, multiplier: float) -> Array:
        return design(system, omega, setting.sampling.angle(omega), multiplier, noise)

    def variance(multiplier: float) -> float:
        worst = 0.0
        for omega in setting.speeds:
            K = gain(omega, multiplier)
            moved = sampled_error(system, K, omega, setting.sampling.angle(omega))
            worst = max(worst, float(variance_gain([(moved, K, input_row(system))]).max()))
        return worst

    multiplier = found.collect(meet, demand, variance)
    return (None, None) if multiplier is None else (lambda omega: gain(omega, multiplier), multiplier)
