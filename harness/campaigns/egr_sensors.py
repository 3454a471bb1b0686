"""Writes the campaign `egr-sensors`: `python -m harness.campaigns.egr_sensors` prints egr-sensors.yaml.

The reference engine is driven through the cycle once without observers. From that record the noise of the control
model, linear at the named point, is estimated as `crankbench noise` does, and from the noise the expected error of
every set of sensors as `crankbench select --method optimal` does. tests/test_egr_sensors.py holds the file to it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from fmus.plants.turbo_si_egr import ACCURACIES, SENSORS
from harness.campaigns.egr_noise import (
    AFTER,
    CRANK_CLOCK,
    EKF_SETS,
    FAMILIES,
    INPUTS_AT,
    LAG,
    LASTING,
    MEASURED,
    OWN_SETS,
    PARAMETER_SET,
    POINT,
    REFERENCE,
    SETS,
    Estimated,
    Family,
    Set,
    estimated,
    head,
    named,
    origin,
)
from harness.campaigns.egr_report import report

# Angle between two samples of the extended Kalman filters, and the time that it is at the named point [s].
EKF_ANGLE, EKF_SAMPLE = "60 deg", 60.0 / 360.0 * 60.0 / 3200.0


def campaign(found: Estimated) -> Iterator[str]:
    """The lines of egr-sensors.yaml."""
    yield "# Written by `python -m harness.campaigns.egr_sensors`, which says where the numbers come from."
    yield from head(CRANK_CLOCK)
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
    yield from report(found)


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


PLANT = "fmus.plants.turbo_si_egr"
AT = f"{{{', '.join(text.replace('=', ': ') for text in POINT)}}}"
INPUTS = (
    "{N: N, throttle: throttle, wastegate: wastegate, egr_valve: egr_valve, n_firing: n_firing, "
    "IVO: IVO, IVC: IVC, EVO: EVO, EVC: EVC}"
)
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
