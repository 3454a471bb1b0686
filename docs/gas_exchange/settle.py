"""Find the steady cycle in which `gas_exchange` starts, and write it into fmus/working_cycle/rest.py.

`python docs/gas_exchange/settle.py` runs the exported plant for 15 s in whole cycles, at the start values of its inputs
and from the states of before.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fmus.component import Vector
from fmus.export import cached_fmu
from fmus.fmu import load_fmu
from fmus.plants.gas_exchange import MODEL
from fmus.units import parse_unit
from fmus.working_cycle.engine_signals import AVERAGED

HELD = ("m_", "U_", "b_", "W_c", "K_tc")
SECONDS = 15.0
TARGET = Path(__file__).resolve().parents[2] / "fmus" / "working_cycle" / "rest.py"


def settled() -> tuple[dict[str, list[float]], dict[str, float]]:
    """Values of the states by name, those of arrays in order, and the means, in the units that are declared."""
    shown = replace(
        MODEL,
        states=tuple(replace(signal, local=False) for signal in MODEL.states),
        discrete=tuple(replace(signal, local=False) for signal in MODEL.discrete),
    )
    component = load_fmu(cached_fmu(shown))
    u = np.array([parse_unit(signal.unit).to_si(float(signal.start)) for signal in MODEL.inputs])
    cycle = 4.0 * np.pi / u[0]
    component.start(0.0, u)
    y: Vector = np.zeros(0)
    for k in range(round(SECONDS / cycle)):
        y = component.step(k * cycle, cycle, u)
    component.close()
    values = dict(zip((signal.name for signal in component.outputs), y.tolist(), strict=True))
    states = {
        signal.name: [values[name] for name in signal.scalar_names()]
        for signal in MODEL.states
        if signal.name.startswith(HELD)
    }
    means = {signal.name: values[signal.name] for signal in AVERAGED}
    speed = values["omega_e"]
    power = values["IMEP"] * speed / (4.0 * np.pi) * 4 * 0.25 * np.pi * _parameter("bore") ** 2 * _parameter("stroke")
    return states, {**means, "power": power, "speed": speed, "time": 1.0}


def _parameter(name: str) -> float:
    return next(float(signal.start) for signal in MODEL.parameters if signal.name == name)


def written(states: dict[str, list[float]], means: dict[str, float]) -> str:
    """The text of the module."""
    lines = [
        '"""The steady cycle in which the plant `gas_exchange` starts: its states at theta = 0, and the means.',
        "",
        "Computed [C] by `python docs/gas_exchange/settle.py` at the inputs' start values.",
        '"""',
        "",
        "STATES: dict[str, float | tuple[float, ...]] = {",
    ]
    for name, values in states.items():
        shown = ", ".join(f"{value:.10g}" for value in values)
        lines.append(f'    "{name}": {shown if len(values) == 1 and not name.startswith("b_") else f"({shown},)"},')
    lines += ["}", "MEANS = {", *(f'    "{name}": {value:.10g},' for name, value in means.items()), "}"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    TARGET.write_text(written(*settled()), encoding="utf-8")
    print(TARGET)
