"""Writes the campaign `egr-sensors`: `python -m harness.campaigns.egr_sensors` prints egr-sensors.yaml.

The reference engine is driven through the cycle once without observers. From that record the noise of the control
model, linear at the named point, is estimated as `crankbench noise` does, and from the noise the expected error of
every set of sensors as `crankbench select --method optimal` does. tests/test_egr_sensors.py holds the file to it.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

from fmus.plants import turbo_si_egr
from fmus.plants.turbo_si_egr import ACCURACIES, LAGS, SENSORS
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
# Angle between two samples of the extended Kalman filters, and the time that it is at the named point [s].
EKF_ANGLE, EKF_SAMPLE = "60 deg", 60.0 / 360.0 * 60.0 / 3200.0
# Who runs beside: filters on the model where it rests itself, and extended Kalman filters.
OWN_SETS: tuple[Set, ...] = ((), ("EGR_DP",), ("EGR_DP", "MAFa"))
EKF_SETS: tuple[Set, ...] = (("EGR_DP",), ("EGR_DP", "MAFa"), SENSORS)


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
        file.write_text("\n".join([*_head(clock), *sensed]) + "\n", encoding="utf-8")
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


def campaign(found: Estimated) -> Iterator[str]:
    """The lines of egr-sensors.yaml."""
    yield "# Written by `python -m harness.campaigns.egr_sensors`, which says where the numbers come from."
    yield from _head(CRANK_CLOCK)
    yield "  # The noise of a sample is a share of the flow at the named point."
    for name in SENSORS:
        deviation = f"{1e3 * ACCURACIES[name] * REFERENCE[MEASURED[name]]:.4g} g/s"
        of = f"of: plant.{MEASURED[name]}_inst, lag: {LAG[name]}"
        yield f"  {name}: {{use: sensor, {of}, noise: {{std: {deviation}}}}}"
    yield "  # The control model on its inputs alone, and linear filters of every set: none of them sees a pressure."
    yield "  model:"
    yield "    use: observers.model_alone"
    yield f"    with: {{plant: {PLANT}, parameter_set: {PARAMETER_SET}, outputs: [W_cyl]}}"
    yield f"    wires: {INPUTS}"
    yield "    every: 30 deg"
    for kind, family in FAMILIES.items():
        for members in SETS:
            yield from _linear(kind, family, members, found)
    yield "  # The same of the model made linear where it comes to rest itself."
    for members in OWN_SETS:
        yield from _linear("own", FAMILIES["kf"], members, found)
    yield "  # Extended Kalman filters, whose noise of a sample has the same intensity."
    for members in EKF_SETS:
        yield from _extended(members, found)
    yield from _recorded()
    yield from EXPERIMENTS.splitlines()
    yield from _metrics()
    yield from _accept()
    yield from _report(found)


def _head(clock: str) -> list[str]:
    """The lines of the engine on a clock."""
    return HEAD.replace("CLOCK", clock).splitlines()


def _everyone() -> list[str]:
    linear = [named(kind, members) for kind in FAMILIES for members in SETS]
    own = [named("own", members) for members in OWN_SETS]
    return ["model", *linear, *own, *(named("ekf", members) for members in EKF_SETS)]


def _linear(kind: str, family: Family, members: Set, found: Estimated) -> Iterator[str]:
    first = kind == next(iter(FAMILIES)) and not members
    at = f"{{{', '.join(INPUTS_AT).replace('=', ': ')}}}" if kind == "own" else "&point " + AT if first else "*point"
    about = ", ".join(f"{name}: {value}" for name, value in origin().items())
    yield f"  {named(kind, members)}:"
    yield "    use: observers.linear_kalman"
    yield "    with:"
    yield f"      plant: {PLANT}"
    yield f"      parameter_set: {PARAMETER_SET}"
    yield f"      at: {at}"
    yield f"      about: {'&about {' + about + '}' if first else '*about'}"
    yield f"      sensors: [{', '.join(members)}]"
    yield f"      noise: {{{', '.join(f'{name}: {found.noise[name]}' for name in members)}}}"
    anchor = family.by
    process = ", ".join(f"{name}: {value}" for name, value in found.process[family.by].items())
    yield f"      process: {f'&{anchor} {{{process}}}' if kind in FAMILIES and not members else f'*{anchor}'}"
    yield f"      lasting: {LASTING}"
    yield "      outputs: [W_cyl]"
    yield f"    wires: {_wires(members)}"
    yield "    every: 30 deg"


def _extended(members: Set, found: Estimated) -> Iterator[str]:
    lasting = float(LASTING.split()[0])
    noise = {}
    for name in members:
        value, unit = found.noise[name].split(" ", 1)
        noise[name] = f"{float(value) * (lasting / EKF_SAMPLE) ** 0.5:.4g} {unit}"
    yield f"  {named('ekf', members)}:"
    yield "    use: observers.ekf"
    yield "    with:"
    yield f"      plant: {PLANT}"
    yield f"      parameter_set: {PARAMETER_SET}"
    yield f"      sensors: [{', '.join(members)}]"
    yield f"      noise: {{{', '.join(f'{name}: {value}' for name, value in noise.items())}}}"
    yield "      process: *published"
    yield "      uncertainty: 0.05"
    yield "      outputs: [W_cyl]"
    yield "      sample_time: 0 s"
    yield f"    wires: {_wires(members)}"
    yield f"    every: {EKF_ANGLE}"


def _wires(members: Set) -> str:
    return f"{INPUTS[:-1]}{''.join(f', {name}_measured: {name}' for name in members)}}}"


def _recorded() -> Iterator[str]:
    plant = ["N", "wastegate", "egr_valve", "plant.F_im", "plant.W_cyl", "plant.egr_ratio", "plant.IMEP"]
    signals = [*plant, *SENSORS, *(f"{part}.F_im" for part in _everyone())]
    signals += [f"{part}.W_cyl" for part in ("model", "kf_none", "kf_EGR_DP_MAFa")]
    yield f"record: [{', '.join(signals)}]"


def _metrics() -> Iterator[str]:
    yield "metrics:"
    for part in _everyone():
        compared = f"[plant.F_im, {part}.F_im], after: {AFTER}, unit: '%'"
        yield f"  rmse_{part}: {{rmse: {compared}}}"
        yield f"  max_{part}: {{max_error: {compared}}}"
    for part in ("model", "kf_none", "kf_EGR_DP_MAFa"):
        compared = f"[plant.W_cyl, {part}.W_cyl]"
        yield f"  charge_{part}: {{nrmse: {{error: {compared}, by: mean}}, after: {AFTER}, unit: '%'}}"
        yield f"  charge_max_{part}: {{max_error: {compared}, after: {AFTER}, unit: g/s}}"
    yield f"  charge: {{mean: plant.W_cyl, after: {AFTER}, unit: g/s}}"
    yield "  egr_least: {minimum: plant.egr_ratio, after: 0.5 s, unit: '%'}"
    yield "  egr_most: {maximum: plant.egr_ratio, after: 0.5 s, unit: '%'}"


def _accept() -> Iterator[str]:
    yield "accept:"
    yield "  # The cycle is the one that was meant."
    yield "  - egr_least < 2 %"
    yield "  - egr_most > 10 %"
    yield "  # What is measured must be worth more than the linear model alone."
    yield "  - rmse_kf_EGR_DP_MAFa_MAFh_MAF < rmse_kf_none"
    yield "  - rmse_kf_EGR_DP < rmse_kf_none"


def _report(found: Estimated) -> Iterator[str]:
    yield "report:"
    yield "  observers:"
    yield "    model: {title: Nonlinear model alone, metrics: [rmse_model, max_model]}"
    for kind, family in FAMILIES.items():
        for members in SETS:
            part = named(kind, members)
            yield f"    {part}: {{title: '{titled(members)}, {family.title}', metrics: [rmse_{part}, max_{part}]}}"
    for members in OWN_SETS:
        part = named("own", members)
        yield f"    {part}: {{title: '{titled(members)}, at rest', metrics: [rmse_{part}, max_{part}]}}"
    for members in EKF_SETS:
        part = named("ekf", members)
        yield f"    {part}: {{title: 'EKF, {titled(members)}', metrics: [rmse_{part}, max_{part}]}}"
    yield from _figures()
    yield from _histograms()
    yield from _published(found)
    yield from _rankings(found)
    yield from _selection(found)


SINGLES: tuple[Set, ...] = ((), *((name,) for name in SENSORS))
PAIRS: tuple[Set, ...] = tuple(combinations(SENSORS, 2))
OPTIMAL: tuple[Set, ...] = ((), ("EGR_DP",), ("EGR_DP", "MAFa"), ("EGR_DP", "MAFa", "MAFh"), SENSORS)


def _figures() -> Iterator[str]:
    yield "  figures:"
    yield "    - {title: 'The cycle (Figure 3): speed', experiment: cycle, traces: [[N.value]], unit: rpm}"
    yield "    - {title: 'The cycle (Figure 3): wastegate', experiment: cycle, traces: [[wastegate.value]], unit: mm}"
    yield "    - {title: 'The cycle (Figure 3): EGR valve', experiment: cycle, traces: [[egr_valve.value]], unit: deg}"
    yield "    - {title: 'EGR rate', experiment: cycle, traces: [[plant.egr_ratio]], unit: '%'}"
    yield "    - {title: 'Load (Figure 4)', experiment: cycle, traces: [[plant.IMEP]], unit: bar}"
    yield "    - title: Charge flow by speed-density (Figure 2)"
    yield "      experiment: cycle"
    yield "      traces: [[plant.W_cyl, model.W_cyl, kf_none.W_cyl]]"
    yield "      unit: g/s"
    for title, sets, begin, end in (
        ("one sensor at most (Figure 9A)", SINGLES, None, None),
        ("one sensor at most, 500 ms of a step of the valve (Figure 9B)", SINGLES, 13.0, 13.5),
        ("two sensors (Figure 11)", PAIRS, None, None),
        ("the best of each size by expectation of the paper (Figure 14)", OPTIMAL, None, None),
    ):
        yield f"    - title: Burnt fraction with {title}"
        yield "      experiment: cycle"
        shown = ", ".join(f"{named('kf', members)}.F_im" for members in sets)
        yield f"      traces: [[plant.F_im, {shown}]]"
        yield "      unit: '%'"
        if begin is not None:
            yield f"      from: {begin:g} s"
            yield f"      to: {end:g} s"


def _histograms() -> Iterator[str]:
    yield "  histograms:"
    for title, sets in (
        ("One sensor at most (Figure 10)", SINGLES),
        ("Two sensors (Figure 13)", PAIRS),
        ("The paper's best of each size (Figure 16)", OPTIMAL),
    ):
        pairs = ", ".join(f"[plant.F_im, {named('kf', members)}.F_im]" for members in sets)
        yield f"    - title: {title}"
        yield f"      pairs: [{pairs}]"
        yield "      experiments: [cycle]"
        yield f"      from: {AFTER}"
        yield "      unit: '%'"


# Table 6, Table 5 and the text of Sections 3.4.1 to 3.4.3: RMSE and largest error [%]; that without sensors is from
# "reduces the RMSE by 47.4 %".
PUBLISHED_ERRORS: dict[Set, tuple[float | None, float | None]] = {
    (): (0.947, 1.744),
    ("EGR_DP",): (0.498, 1.014),
    ("MAFa",): (0.909, 1.684),
    ("MAFh",): (0.935, 1.724),
    ("MAF",): (0.935, 1.724),
    ("EGR_DP", "MAFa"): (0.369, 0.754),
    ("EGR_DP", "MAFh"): (None, 0.794),
    ("EGR_DP", "MAF"): (None, 0.804),
    ("MAFa", "MAFh"): (None, 1.564),
    ("MAFa", "MAF"): (None, 1.594),
    ("MAFh", "MAF"): (None, 1.724),
    ("EGR_DP", "MAFa", "MAFh"): (0.367, None),
    SENSORS: (0.367, None),
}
# Sections 3.4.1 to 3.4.3, in words: what is said, and where it holds.
STATEMENTS = (
    ("EGR-DP is the best single sensor: better than MAFa", "rmse_kf_EGR_DP", "<", "rmse_kf_MAFa"),
    ("... than MAFh", "rmse_kf_EGR_DP", "<", "rmse_kf_MAFh"),
    ("... than MAF", "rmse_kf_EGR_DP", "<", "rmse_kf_MAF"),
    ("MAFa is the second single sensor: better than MAFh", "rmse_kf_MAFa", "<", "rmse_kf_MAFh"),
    ("EGR-DP + MAFa is the best pair: better than EGR-DP + MAFh", "rmse_kf_EGR_DP_MAFa", "<", "rmse_kf_EGR_DP_MAFh"),
    ("... than EGR-DP + MAF", "rmse_kf_EGR_DP_MAFa", "<", "rmse_kf_EGR_DP_MAF"),
    ("EGR-DP + MAFa is better than EGR-DP alone", "rmse_kf_EGR_DP_MAFa", "<", "rmse_kf_EGR_DP"),
    ("MAFa + MAFh is worse than EGR-DP alone", "rmse_kf_MAFa_MAFh", ">", "rmse_kf_EGR_DP"),
    ("MAFa + MAF is worse than EGR-DP alone", "rmse_kf_MAFa_MAF", ">", "rmse_kf_EGR_DP"),
    ("MAFh + MAF is worse than EGR-DP alone", "rmse_kf_MAFh_MAF", ">", "rmse_kf_EGR_DP"),
    ("a third sensor is worth less than 1 %", "rmse_kf_EGR_DP_MAFa_MAFh", ">", "0.99 * rmse_kf_EGR_DP_MAFa"),
    ("... and takes nothing away", "rmse_kf_EGR_DP_MAFa_MAFh", "<=", "1.01 * rmse_kf_EGR_DP_MAFa"),
    ("EGR-DP lowers the error of the model alone by 47 %", "rmse_kf_EGR_DP", "<", "0.53 * rmse_kf_none"),
    ("EGR-DP lowers the largest error by 42 %", "max_kf_EGR_DP", "<", "0.58 * max_kf_none"),
)  # fmt: skip
# Section 3.4.3: by how much the expected error falls with EGR-DP, with MAFa to it, with MAFh to both [%].
FALLS = ((12.2, 23.2), (8.9, 16.9), (0.3, 0.5))


def _published(found: Estimated) -> Iterator[str]:
    yield "  published:"
    for members, (rmse, largest) in PUBLISHED_ERRORS.items():
        for value, metric, what in ((rmse, "rmse", "RMSE"), (largest, "max", "largest error")):
            if value is not None:
                where = f"metric: {metric}_{named('kf', members)}, experiment: cycle"
                yield f"    - {{what: '{what} with {titled(members)}', published: '{value:g} %', {where}}}"
    for said, left, comparison, right in STATEMENTS:
        factor, _, name = right.rpartition(" * ")
        bound = f"{factor} * median({name})" if factor else f"median({name})"
        holds = f"holds: median({left}) {comparison} {bound}"
        yield f"    - {{what: '{said}', published: 'yes', experiment: cycle, {holds}}}"
    for (error, trace), before, after in zip(FALLS, OPTIMAL, OPTIMAL[1:], strict=False):
        ours = ", ".join(
            f"{100.0 * (1.0 - values[after] / values[before]):.1f} % ({by})" for by, values in found.expected.items()
        )
        yield f"    - what: 'expected error falls from {titled(before)} to {titled(after)}'"
        yield f"      published: {error:g} % (its power, trace(T), {trace:g} %)"
        yield f"      ours: '{ours}'"
    yield "    - what: largest error of the charge flow by speed-density, linear model (Figure 2)"
    yield "      published: 5.1 % of the flow"
    yield "      metric: charge_max_kf_none"
    yield "      experiment: cycle"
    yield "      note: the mean flow is that of the metric charge"


def _rankings(found: Estimated) -> Iterator[str]:
    yield "  rankings:"
    for kind, family in FAMILIES.items():
        yield f"    - title: Does the expected error rank the sets as the simulated one? {family.title.capitalize()}"
        yield "      metric: 'rmse_{observer}'"
        yield "      experiments: [cycle]"
        yield "      measures:"
        for by in found.expected if kind == next(iter(FAMILIES)) else [family.by]:
            expected = found.expected[by]
            for name, title, sets in (("all", "", SETS), ("pairs", ", two sensors (Figure 12)", PAIRS)):
                values = ", ".join(f"{named(kind, m)}: {100.0 * expected[m]:.6g}" for m in sets)
                yield f"        {by}_{name}: {{title: 'expected error [%], {by}{title}', values: {{{values}}}}}"


def _selection(found: Estimated) -> Iterator[str]:
    yield "  selection:"
    yield f"    target: {MODEL}"
    yield f"    set: {PARAMETER_SET}"
    yield f"    at: [{', '.join(POINT)}]"
    yield "    about: *about"
    yield "    estimate: [F_im]"
    yield f"    max_sensors: {len(SENSORS)}"
    yield "    method: h2"
    yield f"    noise: {{{', '.join(f'{name}: {value}' for name, value in found.noise.items())}}}"
    yield f"    period: {LASTING}"
    yield "    process: *published"


PLANT = "fmus.plants.turbo_si_egr"
AT = f"{{{', '.join(text.replace('=', ': ') for text in POINT)}}}"
INPUTS = (
    "{N: N, throttle: throttle, wastegate: wastegate, egr_valve: egr_valve, n_firing: n_firing, "
    "IVO: IVO, IVC: IVC, EVO: EVO, EVC: EVC}"
)
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
EXPERIMENTS = """\
experiments:
  cycle:
    description: The drive cycle, three times with noise of its own
    vary: {seed: 1..3}
  offset:
    description: The same with sensors that read too much, and too little, by their accuracy all the time
    vary: {"EGR_DP.gain, MAFa.gain, MAFh.gain, MAF.gain": [[1.05, 1.03, 1.03, 1.03], [0.95, 0.97, 0.97, 0.97]]}"""


if __name__ == "__main__":
    sys.stdout.write("\n".join(campaign(estimated())) + "\n")
