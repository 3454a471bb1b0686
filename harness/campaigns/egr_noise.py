"""The noise of the control model over the cycle of `egr-sensors`, and the error that it lets each set expect."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

from fmus.plants import turbo_si_egr
from fmus.plants.turbo_si_egr import LAGS, SENSORS
from fmus.plants.turbo_si_egr_reference import STEADY
from harness.campaign import read_campaign
from harness.campaigns.egr_cycle import EGR_VALVE, SPEED, WASTEGATE, source
from harness.cases import execute
from harness.operating import Operation
from harness.processnoise import By, NoiseWishes, estimate_noise
from harness.selecting import select
from harness.wishes import Wishes

Set = tuple[str, ...]
SETS: tuple[Set, ...] = tuple(members for size in range(5) for members in combinations(SENSORS, size))
# Who runs beside: filters on the model where it rests itself, and extended Kalman filters.
OWN_SETS: tuple[Set, ...] = ((), ("EGR_DP",), ("EGR_DP", "MAFa"))
EKF_SETS: tuple[Set, ...] = (("EGR_DP",), ("EGR_DP", "MAFa"), SENSORS)
MODEL, PARAMETER_SET = "turbo_si_egr", "reference"
# Where the paper makes its model linear, and what the reference shows there.
INPUTS_AT = ("N=3200 rpm", "throttle=60 deg", "wastegate=11.6 mm", "egr_valve=10 deg")
REFERENCE = STEADY[0]
MEASURED = {"EGR_DP": "W_egr", "MAFa": "W_a", "MAFh": "W_cac", "MAF": "W_mix"}
LAG = {"EGR_DP": "10 ms", "MAFa": "15 ms", "MAFh": "30 ms", "MAF": "15 ms"}
# How long a sensor's error is taken to stay, as the paper's H has it: docs/egr-sensors.md.
LASTING = "1 s"
# As the paper leaves out what the initial values do; and the end of the cycle.
AFTER, SECONDS = "3.3 s", 30


def _quantity(value: float | None, unit: str, digits: int = 4) -> str:
    if value is None:
        raise RuntimeError("a noise was not estimated: the record lacks a state")
    return f"{value:.{digits}g}" if unit == "1" else f"{value:.{digits}g} {unit}"


def origin() -> dict[str, str]:
    """What the reference shows at the named point under the names of the control model, with units."""
    units = {signal.name: signal.unit for signal in (*turbo_si_egr.MODEL.states, *turbo_si_egr.MODEL.outputs)}
    shown = REFERENCE | {sensor: REFERENCE[flow] for sensor, flow in MEASURED.items()}
    return {name: _quantity(value, units[name], 8) for name, value in shown.items() if name in units}


# The control model made linear where the reference rests, as the paper has it: its states are "directly obtained from
# GT-Power simulation results".
STATES_AT = {signal.name: origin()[signal.name] for signal in turbo_si_egr.MODEL.states if signal.name in origin()}
POINT = (*INPUTS_AT, *(f"{name}={value}" for name, value in STATES_AT.items()))
OPERATION = Operation(MODEL, POINT, PARAMETER_SET, about=[f"{name}={value}" for name, value in origin().items()])


class Family(NamedTuple):
    """Linear filters whose gains come from one estimate of the process noise: the first word of their names."""

    by: str
    title: str


# A third estimate, by which nothing is filtered: it says less of most states than their density does.
LIKELIEST = "likelihood"
FAMILIES = {
    "kf": Family("published", "noise as published"),
    "kd": Family("density", "noise by spectral density"),
}


class Estimated(NamedTuple):
    """Process noise by state for each estimate, sensors' noise, and the expected error of F_im of each set [1]."""

    process: Mapping[str, Mapping[str, str]]
    noise: Mapping[str, str]
    expected: Mapping[str, Mapping[Set, float]]


def estimated() -> Estimated:
    """The noise of the control model over the cycle, and what it lets every set expect."""
    by_angle = _noise(CRANK_CLOCK, "720 deg", "published")
    # A likelihood wants rows at one interval: about a cycle of a clock in time.
    by_time = _noise(TIME_CLOCK, "40 ms", "likelihood")
    process = {family.by: _process(by_angle, family.by) for family in FAMILIES.values()}
    process[LIKELIEST] = _process(by_time, "process")
    noise = {row["name"]: _quantity(row["noise"], row["unit"]) for row in by_angle["sensors"]}
    return Estimated(process, noise, {by: _expected(noise, one) for by, one in process.items()})


def _noise(clock: str, average: str, by: By) -> dict[str, Any]:
    """What `crankbench noise` says of a run of the reference engine with sensors that have no noise."""
    with tempfile.TemporaryDirectory() as folder:
        file, run = Path(folder) / "cycle.yaml", Path(folder) / "run"
        sensed = [f"  {n}: {{use: sensor, of: plant.{MEASURED[n]}_inst, lag: {LAG[n]}}}" for n in SENSORS]
        file.write_text("\n".join([*head(clock), *sensed]) + "\n", encoding="utf-8")
        outcomes = set(execute(read_campaign(file), run, 1, lambda ended: None).outcomes.values())
        if outcomes != {"ok"}:
            raise RuntimeError(f"the reference engine ended as {', '.join(outcomes)}")
        return estimate_noise(NoiseWishes(run, OPERATION, part="plant", after=AFTER, average=average, by=by))


def _process(found: Mapping[str, Any], by: str) -> dict[str, str]:
    """Noise by state, none of lags."""
    return {row["name"]: _quantity(0.0 if row["name"] in LAGS else row[by], row["unit"]) for row in found["states"]}


def _expected(noise: Mapping[str, str], process: Mapping[str, str]) -> dict[Set, float]:
    wishes = Wishes(
        estimate=("F_im",), most=len(SENSORS), method="optimal", period=LASTING, process=process,
        noise=[f"{name}={value}" for name, value in noise.items()],
    )  # fmt: skip
    told = select(OPERATION, wishes, (), lambda what, done, total: None).to_json(None)
    by_set = {tuple(row["sensors"]): row["errors"]["F_im"] for row in told["sets"]}
    (size,) = (state["size"] for state in told["states"] if state["name"] == "F_im")
    return {members: by_set[members] if members else told["without_sensors"] * size for members in SETS}


def named(kind: str, members: Sequence[str]) -> str:
    """The name of the part."""
    return "_".join([kind, *(members or ["none"])])


def titled(members: Sequence[str]) -> str:
    """A set in words."""
    return " + ".join(name.replace("_", "-") for name in members) or "no sensor"


def head(clock: str) -> list[str]:
    """The lines of the engine on a clock."""
    return HEAD.replace("CLOCK", clock).splitlines()


CRANK_CLOCK = f"{{crank: {{step: 30 deg, stop: {SECONDS} s, speed: plant.omega_e, angle: plant.theta}}}}"
TIME_CLOCK = f"{{time: {{step: 1 ms, stop: {SECONDS} s}}}}"
HEAD = f"""\
campaign: egr-sensors
description: Which of four sensors estimate the burnt gas in the intake of an engine with EGR (Front. Mech. Eng. 2021)
clock: CLOCK
seed: 1
parts:
  # Speed, wastegate and EGR valve move; all else stays as it is at the named point.
  N: {source(SPEED, "rpm")}
  wastegate: {source(WASTEGATE, "mm")}
  egr_valve: {source(EGR_VALVE, "deg")}
  throttle: {{use: source, unit: deg, constant: 60 deg}}
  n_firing: {{use: source, unit: '1', constant: 4}}
  IVO: {{use: source, unit: deg, constant: -5 deg}}
  IVC: {{use: source, unit: deg, constant: 220 deg}}
  EVO: {{use: source, unit: deg, constant: -225 deg}}
  EVC: {{use: source, unit: deg, constant: 15 deg}}
  lambda_: {{use: source, unit: '1', constant: 1}}
  p_a: {{use: source, unit: Pa, constant: 1.01325 bar}}
  T_a: {{use: source, unit: K, constant: 298 K}}
  # The actuators lag; observers know what is commanded.
  wastegate_at: {{use: sensor, of: wastegate.value, lag: 100 ms}}
  egr_valve_at: {{use: sensor, of: egr_valve.value, lag: 50 ms}}
  plant:
    use: fmus.plants.gas_exchange
    wires:
      N: N
      throttle: throttle
      wastegate: wastegate_at
      egr_valve: egr_valve_at
      lambda: lambda_
      p_a: p_a
      T_a: T_a"""
