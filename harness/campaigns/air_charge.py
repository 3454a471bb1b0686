"""Writes the campaign `air-charge`: `python -m harness.campaigns.air_charge` prints air-charge.yaml.

Sets of three sensors of the 17, and what each measure says of them, are computed here by `selection` at the
equilibrium of set A, with the noise that the campaign's sensors have. tests/test_air_charge.py holds the file to it.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any, NamedTuple

from fmus.plants.turbo_si import SENSORS
from harness.campaigns.air_charge_truth import ENGINES, OFF
from harness.operating import Operation
from harness.selecting import select
from harness.wishes import Wishes
from selection.methods import METHODS

Set = tuple[str, ...]
WANTED = ("p_im", "T_im", "p_em")
# A tolerance from a data sheet is taken for three standard deviations of white noise [I].
#   pressures    piezoresistive, 20 to 300 kPa, tolerance 3 kPa (a maker's PST 3); behind the cylinders 600 kPa and 1 %
#                of it [I]
#   temperatures NTC in the intake, 1 K [I]; thermocouple class 1 in the exhaust, 0.4 % of 950 degC (IEC 60584)
#   flows        hot film, 3 % of the reading (the class of HFM5), of the flow at 2000 rpm and a throttle of 0.15
#   speed        eddy current, 0.5 % of 9000 rad/s [I]
NOISE = {
    "p_af": "1000 Pa", "T_af": "0.33 K", "p_comp": "1000 Pa", "T_comp": "0.33 K", "p_ic": "1000 Pa", "T_ic": "0.33 K",
    "p_im": "1000 Pa", "T_im": "0.33 K", "p_em": "2000 Pa", "T_em": "1.3 K", "p_t": "2000 Pa", "T_t": "1.3 K",
    "omega_tc": "15 rad/s", "W_af": "0.22 g/s", "W_comp": "0.22 g/s", "W_ic": "0.22 g/s", "W_th": "0.22 g/s",
}  # fmt: skip
PERIOD = "10 ms"
# What each state strays in a second by itself, of its nominal value [I]: as much as the parts are off.
PROCESS = OFF
TABLE_1: tuple[Set, ...] = (
    ("p_im", "T_im", "p_em"),
    ("p_ic", "p_im", "T_im"),
    ("p_im", "T_im", "W_th"),
    ("p_im", "p_em", "T_em"),
    ("p_im", "p_em", "p_t"),
    ("T_im", "p_em", "T_em"),
)
# Whom the other filters run beside: the best of Table 1, and what engines have.
OTHER_FILTERS = TABLE_1[:2]
RANDOM_SETS, SEED = 20, 2005


class Measure(NamedTuple):
    """A measure of sets: its key in what `select` gives, its title, and which values are better."""

    key: str
    title: str
    better: str


MEASURES = {
    "index_structural": Measure("index", "observability index, structural", "lower"),
    "index_coupled": Measure("index", "observability index, couplings kept", "lower"),
    "index_exact": Measure("index", "observability index, exact at the equilibrium", "lower"),
    "index_numerical": Measure("index", "observability index, numerical", "lower"),
    "kalman_error": Measure("error", "steady error of a Kalman filter", "lower"),
    "gramian_least": Measure("gramian_least", "least eigenvalue of the Gramian", "higher"),
    "gramian_log_det": Measure("gramian_log_det", "log det of the Gramian", "higher"),
    "gramian_trace_inverse": Measure("gramian_trace_inverse", "trace of the inverse Gramian", "lower"),
}
Values = Mapping[Set, float | None]


def measured() -> dict[str, dict[Set, float | None]]:
    """What each measure says of each of the 680 sets of three sensors; None where it has no value."""
    found: dict[str, dict[Set, float | None]] = {}
    for method in METHODS:
        others = () if method != METHODS[0] else ("gramian", "kalman")
        wishes = Wishes(
            estimate=WANTED, most=3, method=method, measures=others, period=PERIOD, process=PROCESS, threads=2,
            noise=[f"{name}={noise}" for name, noise in NOISE.items()],
        )  # fmt: skip
        rows = select(Operation("turbo_si"), wishes, (), lambda what, done, total: None).sets()
        triples = {tuple(row["sensors"]): row for row in rows if len(row["sensors"]) == 3}
        for name, measure in MEASURES.items():
            if name == f"index_{method}" or (others and measure.key != "index"):
                found[name] = {members: row[measure.key] for members, row in triples.items()}
    return found


def extremes(values: Values, better: str) -> tuple[Set, Set]:
    """The best and the worst set by a measure; of equals the first in the order of the sensors, and none is worst."""
    sign = 1.0 if better == "lower" else -1.0
    costs = {members: float("inf") if value is None else sign * value for members, value in values.items()}
    ordered = sorted(costs, key=lambda members: [SENSORS.index(name) for name in members])
    return min(ordered, key=costs.__getitem__), max(ordered, key=costs.__getitem__)


def random_sets() -> list[Set]:
    """Twenty of the 680, drawn by `random.Random(2005)`, without one twice."""
    return random.Random(SEED).sample(list(combinations(SENSORS, 3)), RANDOM_SETS)


def chosen(found: Mapping[str, Values]) -> list[Set]:
    """All sets that are run: those of Table 1, the best and worst by each measure, the random ones; each once."""
    by_measure = [members for name, measure in MEASURES.items() for members in extremes(found[name], measure.better)]
    return list(dict.fromkeys([*TABLE_1, *by_measure, *random_sets()]))


def observer(kind: str, members: Iterable[str]) -> str:
    """The name of the part."""
    return "_".join([kind, *members])


# The speed of the WLTC of class 3b (UN GTR 15, annex 1) from 825 s on, each second, km/h.
WLTC_FROM = 825
WLTC: tuple[float, ...] = (
    33.0, 35.1, 37.1, 38.9, 41.4, 44.0, 46.3, 47.7, 48.2, 48.7, 49.3, 49.8, 50.2, 50.9, 51.8, 52.5, 53.3, 54.5,
    55.7, 56.5, 56.8, 57.0, 57.2, 57.7, 58.7, 60.1, 61.1, 61.7, 62.3, 62.9, 63.3, 63.4, 63.5, 64.5, 65.8, 66.8,
    67.4, 68.8, 71.1, 72.3, 72.8, 73.4, 74.6, 76.0, 76.6, 76.5, 76.2, 75.8, 75.4, 74.8, 73.9, 72.7, 71.3, 70.4,
    70.0, 70.0, 69.0, 68.0, 68.0, 68.0, 68.1,
)  # fmt: skip
# [I] Third gear of a small car, its tyres, its road load.
RATIO, TYRE, MASS, ROLLING, DRAG = 4.5, 0.31, 1400.0, 0.011, 0.40  # 1, m, kg, 1, kg/m (half the density times c_d A)
# Set A at the start values of `turbo_si`: N.m, rpm, opening. Area goes with power, as if the throttle choked [I].
AT_POINT = (92.2, 2000.0, 0.15)
LEAST_OPENING = 0.06
EXPERIMENTS = ("tip_in", "tip_out", "wastegate", "wltc")


def engine_speed() -> list[float]:
    """Engine speed [rpm] in the piece of the cycle, each second, in a gear of a fixed ratio."""
    return [v / 3.6 / TYRE * RATIO * 60.0 / (2.0 * math.pi) for v in WLTC]


def throttle() -> list[float]:
    """Throttle opening in the piece, each second: what the power for road load and acceleration wants.

    alpha = alpha_0 sqrt(T n/(T_0 n_0)), T = r/i (m a + m g f + 1/2 rho c_d A v^2), and no less than when coasting.
    """
    torque_0, speed_0, opening_0 = AT_POINT
    found = []
    for k, n in enumerate(engine_speed()):
        before, after = WLTC[max(k - 1, 0)], WLTC[min(k + 1, len(WLTC) - 1)]
        acceleration = (after - before) / 3.6 / (min(k + 1, len(WLTC) - 1) - max(k - 1, 0))
        force = MASS * (acceleration + 9.81 * ROLLING) + DRAG * (WLTC[k] / 3.6) ** 2
        power = max(force * TYRE / RATIO, 0.0) * n
        found.append(max(opening_0 * math.sqrt(power / (torque_0 * speed_0)), LEAST_OPENING))
    return found


def campaign(found: Mapping[str, Values]) -> Iterator[str]:
    """The lines of air-charge.yaml."""
    yield from HEAD.splitlines()
    yield from (f"  s_{name}: {_sensor(name)}" for name in SENSORS)
    yield "  # The model on its inputs alone."
    yield "  open_loop:"
    yield "    use: observers.model_alone"
    yield f"    with: {{plant: {PLANT}, outputs: [cac_stroke]}}"
    yield f"    wires: {INPUTS}"
    sets = chosen(found)
    yield "  # Extended Kalman filters: Table 1, the best and worst by each measure, twenty drawn, and every sensor."
    for members in [*sets, SENSORS]:
        yield from _filter("ekf", _name("ekf", members), members, {"uncertainty": OFF})
    yield "  # Other filters on the best set and on the one that engines have."
    for members in OTHER_FILTERS:
        yield from _filter("ukf", observer("ukf", members), members, {"uncertainty": OFF})
        grid = "{N: '[1300, 2000, 2900] rpm', alpha: '[0.08, 0.15, 0.3]'}"
        inputs = "{lambda: 1, u_wg: 0, p_a: 101300 Pa, T_a: 298 K}"
        more = {"at": inputs, "grid": grid}
        yield from _filter("constant_gain", observer("constant_gain", members), members, more)
    shown = ["open_loop", *(_name("ekf", members) for members in [*sets, SENSORS])]
    shown += [observer(kind, members) for members in OTHER_FILTERS for kind in ("ukf", "constant_gain")]
    recorded = [f"{part}.cac_stroke" for part in shown]
    yield f"record: [plant.cac_stroke, plant.p_im, plant.T_im, plant.p_em, {', '.join(recorded)}]"
    yield from _experiments()
    yield "metrics:"
    for part in shown:
        compared = f"{{error: [plant.cac_stroke, {part}.cac_stroke], by: mean}}"
        yield f"  charge_{part}: {{nrmse: {compared}, after: 8 s, unit: '%', only: [{', '.join(EXPERIMENTS)}]}}"
    yield from MIDDLE.splitlines()
    yield "  observers:"
    yield "    open_loop: {title: Model alone, metrics: [charge_open_loop]}"
    for part, title in _titles(sets):
        yield f"    {part}: {{title: '{title}', metrics: [charge_{part}]}}"
    yield from _published(found)
    yield "  selection:"
    yield "    target: turbo_si"
    yield f"    estimate: [{', '.join(WANTED)}]"
    yield f"    noise: {{{', '.join(f'{name}: {noise}' for name, noise in NOISE.items())}}}"
    yield f"    period: {PERIOD}"
    yield f"    process: {PROCESS}"
    # At the start values the throttle does not choke; there it does, and p_im acts on nothing before it.
    yield "    also_at: ['p_im=40 kPa']"
    yield "  rankings:"
    yield from _ranking("Does a better measure mean a smaller error of the air charge? The sets run", found, sets)
    note = f"Sets picked for being extreme make any relation look stronger: drawn by random.Random({SEED})"
    yield from _ranking("The same of the twenty sets drawn", found, random_sets(), note)


PLANT = "fmus.plants.turbo_si"
INPUTS = "{N: N, alpha: alpha, lambda: lambda_, u_wg: u_wg, p_a: p_a, T_a: T_a}"
HEAD = f"""\
# Written by `python -m harness.campaigns.air_charge`, which says where the numbers come from.
campaign: air-charge
description: Which three of 17 sensors see the air charge of a turbocharged engine, put to the test (IFAC 2005)
clock: {{time: {{step: 10 ms, stop: 30 s}}}}
seed: 1
parts:
  N: {{use: source, unit: rpm, constant: 2000 rpm}}
  alpha: {{use: source, unit: '1', constant: 0.15}}
  lambda_: {{use: source, unit: '1', constant: 1}}
  u_wg: {{use: source, unit: '1', constant: 0}}
  p_a: {{use: source, unit: Pa, constant: 101300 Pa}}
  T_a: {{use: source, unit: K, constant: 298 K}}
  # Explicit steps of a fixed length, where the filters' models take implicit ones that adapt.
  plant:
    use: harness.campaigns.air_charge_truth
    with: {{solver.method: 1, solver.step: 50 us, solver.tolerance: 0}}
    wires: {INPUTS}
  # A tolerance from a data sheet is three standard deviations. Temperatures lag by 3 s."""
MIDDLE = """\
  integration:
    description: Without sensors and with the same parameters only the two integrations differ
    nrmse: {error: [plant.cac_stroke, open_loop.cac_stroke], by: mean}
    only: [same_engine]
accept:
  # Both integrations solve the same equations.
  - {same_engine: integration < 1e-4}
  # To measure the very states that the charge is made of is worth more than the model alone.
  - median(charge_ekf_p_im_T_im_p_em) < median(charge_open_loop)
  # So is everything that can be measured.
  - median(charge_ekf_all) < median(charge_open_loop)
report:
  figures:
    - title: Air charge of a cylinder at a tip-in
      experiment: tip_in
      traces: [[plant.cac_stroke, ekf_p_im_T_im_p_em.cac_stroke, ekf_p_ic_p_im_T_im.cac_stroke, open_loop.cac_stroke]]
      unit: mg
      from: 8 s
    - title: Air charge of a cylinder in the piece of the WLTC
      experiment: wltc
      traces: [[plant.cac_stroke, ekf_p_im_T_im_p_em.cac_stroke, ekf_p_ic_p_im_T_im.cac_stroke, open_loop.cac_stroke]]
      unit: mg
      from: 8 s"""
PUBLISHED = {
    TABLE_1[0]: (2, "the only one with 2 of all 680 by each method"),
    TABLE_1[1]: (3, ""),
    TABLE_1[2]: (3, ""),
    TABLE_1[3]: (3, ""),
    TABLE_1[4]: (4, "y and three derivatives: 9 equations for the 10 states not measured"),
    TABLE_1[5]: (4, "the first derivatives of p_em and T_em, one later for its lag, give p_im and p_t; so 3"),
}


def _sensor(name: str) -> str:
    lag = "lag: 3 s, " if name.startswith("T_") else ""
    return f"{{use: sensor, of: plant.{name}, {lag}noise: {{std: {NOISE[name]}}}}}"


def _name(kind: str, members: Sequence[str]) -> str:
    return f"{kind}_all" if tuple(members) == SENSORS else observer(kind, members)


def _filter(module: str, part: str, members: Sequence[str], more: Mapping[str, Any]) -> Iterator[str]:
    noise = ", ".join(f"{name}: {NOISE[name]}" for name in members)
    wires = ", ".join(f"{name}_measured: s_{name}" for name in members)
    yield f"  {part}:"
    yield f"    use: observers.{module}"
    yield "    with:"
    yield f"      plant: {PLANT}"
    yield f"      sensors: [{', '.join(members)}]"
    yield f"      noise: {{{noise}}}"
    yield f"      process: {PROCESS}"
    yield from (f"      {key}: {value}" for key, value in more.items())
    yield "      outputs: [cac_stroke]"
    yield f"      sample_time: {PERIOD}"
    yield f"    wires: {INPUTS[:-1]}, {wires}}}"


def _table(values: Iterable[float], unit: str, digits: int, begin: int = 0) -> str:
    """A source of one value a second, joined by lines."""
    numbers = [f"{value:.{digits}f}" for value in values]
    times = ", ".join(f"{begin + k} s" for k in range(len(numbers)))
    of_unit = "" if unit == "1" else f" {unit}"
    shown = ", ".join(f"{number}{of_unit}" for number in numbers)
    return f"{{use: source, unit: '{unit}', table: {{time: [{times}], value: [{shown}], between: linear}}}}"


def _held(points: Mapping[int, float]) -> str:
    times, values = ", ".join(f"{t} s" for t in points), ", ".join(map(str, points.values()))
    return f"{{use: source, unit: '1', table: {{time: [{times}], value: [{values}]}}}}"


def _experiments() -> Iterator[str]:
    engines = ", ".join(f"engine_{number}" for number in ENGINES)
    first = f"&engines {{'plant.set, seed': [{', '.join(f'[engine_{n}, {n}]' for n in ENGINES)}]}}"
    yield "experiments:"
    yield f"  # {engines}: every part off by up to {100 * OFF:g} %, each with noise of its own."
    yield "  tip_in:"
    yield "    description: Throttle from 0.12 to 0.3 at 12 s, 2000 rpm"
    yield f"    parts: {{alpha: {_held({0: 0.12, 12: 0.3})}}}"
    yield f"    vary: {first}"
    yield "  tip_out:"
    yield "    description: Throttle from 0.3 to 0.12 at 12 s, 2000 rpm"
    yield f"    parts: {{alpha: {_held({0: 0.3, 12: 0.12})}}}"
    yield "    vary: *engines"
    yield "  wastegate:"
    yield "    description: Wastegate from closed to half open at 12 s, to a fifth at 20 s; throttle 0.3, 2000 rpm"
    yield "    parts:"
    yield "      alpha: {use: source, unit: '1', constant: 0.3}"
    yield f"      u_wg: {_held({0: 0.0, 12: 0.5, 20: 0.2})}"
    yield "    vary: *engines"
    yield "  wltc:"
    seconds = len(WLTC) - 1
    gear = f"one gear ({RATIO:g}, tyres {TYRE:g} m)"
    yield f"    description: WLTC of class 3b from {WLTC_FROM} s on for {seconds} s, {gear}"
    yield "    parts:"
    yield f"      N: {_table(engine_speed(), 'rpm', 0)}"
    yield f"      alpha: {_table(throttle(), '1', 4)}"
    yield f"    set: {{clock.time.stop: {seconds} s}}"
    yield "    vary: *engines"
    yield "  same_engine:"
    yield "    description: Tip-in with an engine that is set A itself"
    yield f"    parts: {{alpha: {_held({0: 0.12, 12: 0.3})}}}"


def _titles(sets: Sequence[Set]) -> Iterator[tuple[str, str]]:
    yield "ekf_all", "EKF, all 17"
    yield from ((observer("ekf", members), f"EKF: {', '.join(members)}") for members in sets)
    for members in OTHER_FILTERS:
        yield observer("ukf", members), f"UKF: {', '.join(members)}"
        yield observer("constant_gain", members), f"Constant gains: {', '.join(members)}"


def _published(found: Mapping[str, Values]) -> Iterator[str]:
    yield "  published:"
    for members, (index, note) in PUBLISHED.items():
        ours = ", ".join(f"{method} {_number(found[f'index_{method}'][members])}" for method in METHODS)
        yield f"    - what: 'Table 1: observability index of {', '.join(members)}'"
        yield f"      published: {index}"
        yield f"      ours: '{ours}'"
        if note:
            yield f"      note: '{note}'"


def _ranking(title: str, found: Mapping[str, Values], sets: Sequence[Set], note: str = "") -> Iterator[str]:
    yield f"    - title: '{title}'"
    yield "      metric: 'charge_{observer}'"
    yield f"      experiments: [{', '.join(EXPERIMENTS)}]"
    if note:
        yield f"      note: '{note}'"
    yield "      measures:"
    for name, measure in MEASURES.items():
        values = ", ".join(f"{observer('ekf', members)}: {_number(found[name][members])}" for members in sets)
        yield f"        {name}: {{title: '{measure.title}', better: {measure.better}, values: {{{values}}}}}"


def _number(value: float | None) -> str:
    return "null" if value is None else f"{value:.4g}"


if __name__ == "__main__":
    sys.stdout.write("\n".join(campaign(measured())) + "\n")
