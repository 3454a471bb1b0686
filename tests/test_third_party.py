"""FMUs of other tools run as campaigns, by Co-Simulation and Model Exchange, and do as FMPy's own runs of them do."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as parquet
import pytest
from numpy.typing import NDArray
from third_party import OPENMODELICA, pythonfmu3_fmu, pythonfmu_fmu, reference_fmu, third_party_fmu

from fmus.description import describe
from fmus.toolchain import native_platform

pytestmark = pytest.mark.skipif(
    native_platform() != "linux64", reason="the FMUs of gemseo-fmu and CoupledClutches are for 64-bit Linux"
)

# FMPy adds up its times, so that they differ from t0 + k h in the last places; an FMU that looks at them follows.
ROUNDED = 1e-13
# Two integrations with this relative tolerance each, whose errors pile up over some hundred steps.
TOLERANCE = 1e-8
EXCHANGED = 1e-5


class Try(NamedTuple):
    """An FMU, how long it runs with what step [s], and the values of its inputs."""

    name: str
    step: float
    stop: float
    inputs: Mapping[str, float] = {}


TRIES = (
    *(Try(f"{model}-{fmi}", step, stop) for fmi in (2, 3) for model, step, stop in (
        ("Dahlquist", 0.1, 5.0), ("VanDerPol", 0.01, 5.0), ("BouncingBall", 0.01, 1.5), ("Stair", 0.2, 4.0),
        ("Feedthrough", 0.1, 1.0),
    )),
    Try("StateSpace-3", 0.01, 1.0),
    Try("CoupledClutches_CS_linux64", 0.01, 1.5, {"inputs": 1.0}),
    *(Try(name, 0.01, 1.0, inputs) for name, inputs in (
        ("Mass_Damper", {"f": 10.0}), ("MassSpringSystem", {}), ("MassSpringSubSystem1", {"x2": 0.5}),
        ("MassSpringSubSystem2", {"x1": 0.5}), ("add", {"u1": 2.0, "u2": 3.0}), ("ramp", {}),
        ("FMU3Model", {}),
    )),
    Try("Follower", 0.01, 1.0),
    Try("Decay", 0.01, 1.0),
)  # fmt: skip


def path_of(name: str, folder: Path) -> Path:
    model, _, version = name.rpartition("-")
    if model:
        return reference_fmu(model, int(version))
    if name in ("Follower", "Decay"):
        return pythonfmu_fmu(folder) if name == "Follower" else pythonfmu3_fmu(folder)
    if name.startswith("CoupledClutches"):
        return third_party_fmu(f"{name}.fmu")
    return third_party_fmu(f"{name}.fmu", OPENMODELICA)


class Ran(NamedTuple):
    """One FMU run by one kind, in crankbench."""

    asked: Try
    kind: str
    path: Path
    inputs: Mapping[str, float]
    case: Mapping[str, object]
    signals: Mapping[str, NDArray[np.float64]]


def campaign(paths: Mapping[str, Path]) -> tuple[dict[str, object], dict[str, tuple[Try, str, Mapping[str, float]]]]:
    """A campaign with an experiment for each FMU and kind; what each experiment is."""
    experiments: dict[str, object] = {}
    asked = {}
    for one in TRIES:
        description = describe(paths[one.name])
        for kind in description.kinds:
            name = f"{one.name}_{kind}".replace("-", "_")
            inputs = {
                scalar: one.inputs.get(scalar, float(value))
                for variable in description.variables
                if variable.on_bus and variable.causality == "input"
                for scalar, value in zip(variable.scalar_names(), variable.start, strict=True)
            }
            sources = {f"input_{i}": value for i, value in enumerate(inputs.values())}
            units = {s: v.unit for v in description.variables for s in v.scalar_names()}
            parts: dict[str, object] = {
                part: {"use": "source", "unit": units[scalar] or "1", "constant": f"{value} {units[scalar]}".strip()}
                for (part, value), scalar in zip(sources.items(), inputs, strict=True)
            }
            wires = dict(zip(inputs, sources, strict=True))
            solver = {"solver.tolerance": TOLERANCE} if kind == "me" else {}
            parts["plant"] = {"use": str(paths[one.name]), "kind": kind, "wires": wires, "with": solver}
            clock = {"clock.time.step": f"{one.step} s", "clock.time.stop": f"{one.stop} s"}
            experiments[name] = {"parts": parts, "set": clock}
            asked[name] = (one, kind, inputs)
    clock = {"time": {"step": "1 s", "stop": "1 s"}}
    unused = {"unused": {"use": "source", "unit": "1", "constant": 0}}
    return {"campaign": "third_party", "clock": clock, "parts": unused, "experiments": experiments}, asked


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Ran]]:
    """All of them, run by one `crankbench run`."""
    folder = tmp_path_factory.mktemp("third_party")
    paths = {one.name: path_of(one.name, folder) for one in TRIES}
    document, asked = campaign(paths)
    (folder / "third_party.yaml").write_text(json.dumps(document))
    command = [sys.executable, "-m", "harness", "run", str(folder / "third_party.yaml"), "--out", str(folder / "out")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode in (0, 1), result.stderr
    found = {}
    for file in folder.glob("out/cases/*/case.json"):
        case = json.loads(file.read_text())
        table = parquet.read_table(file.with_name("signals.parquet"))
        signals = {name: table[name].to_numpy() for name in table.column_names}
        one, kind, inputs = asked[case["experiment"]]
        found[case["experiment"]] = Ran(one, kind, paths[one.name], inputs, case, signals)
    assert found.keys() == asked.keys()
    yield found


NAMES = [f"{one.name}_{kind}".replace("-", "_") for one in TRIES for kind in ("cs", "me")
         if kind == "cs" or one.name not in ("CoupledClutches_CS_linux64", "FMU3Model", "Follower")]  # fmt: skip


def test_every_kind_that_they_offer_is_tried(ran: Mapping[str, Ran]):
    assert sorted(ran) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_it_runs_to_its_end(name: str, ran: Mapping[str, Ran]):
    case, one = ran[name].case, ran[name].asked
    assert (case["outcome"], case["message"]) == ("ok", "")
    assert ran[name].signals["time"][-1] == pytest.approx(one.stop)


# FMPy takes no start values for arrays; and two FMUs with their own Python modules inside end a process like this one.
ELSEWHERE = ("StateSpace", "FMU3Model", "Follower", "Decay")


@pytest.mark.parametrize("name", [name for name in NAMES if not name.startswith(ELSEWHERE)])
def test_its_outputs_are_those_of_fmpys_own_run(name: str, ran: Mapping[str, Ran]):
    """By the same calls, Co-Simulation gives the same bytes; Model Exchange is another integration of the same."""
    one = ran[name]
    theirs = fmpy_run(one)
    outputs = [output for output in theirs if f"plant.{output}" in one.signals]
    assert outputs, "something is compared"
    worst = max(deviation(one.signals[f"plant.{output}"], theirs[output]) for output in outputs)
    print(f"deviation {name} {worst:.1e}")
    assert worst <= (ROUNDED if one.kind == "cs" else EXCHANGED)


def deviation(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> float:
    """The largest difference over the largest value, at least 1."""
    assert len(ours) == len(theirs)
    return float(np.abs(ours - theirs).max() / max(1.0, np.abs(theirs).max()))


def fmpy_run(one: Ran) -> dict[str, NDArray[np.float64]]:
    """The outputs by name, in SI, of FMPy's run with the same steps, inputs held from the start."""
    from fmpy import simulate_fmu

    description = describe(one.path)
    variables = {v.name: v for v in description.variables if v.on_bus and v.causality == "output"}
    result = simulate_fmu(
        str(one.path),
        fmi_type="CoSimulation" if one.kind == "cs" else "ModelExchange",
        stop_time=one.asked.stop,
        step_size=one.asked.step,
        output_interval=one.asked.step,
        relative_tolerance=TOLERANCE,
        start_values=dict(one.inputs),
        output=list(variables),
        record_events=False,
        set_stop_time=False,
    )
    found = {}
    for name, variable in variables.items():
        values = np.asarray(result[name], dtype=float).reshape(len(result), -1)
        for scalar, column in zip(variable.scalar_names(), values.T, strict=True):
            found[scalar] = variable.quantity.to_si(column) if variable.quantity is not None else column
    return found


def test_the_mass_and_damper_of_openmodelica_moves_as_newton_says(ran: Mapping[str, Ran]):
    """m z'' = f - d z' - c z, z = y + 0.5 m, with the FMU's own c = 1e4 N/m, d = 10 N.s/m, m = 1 kg, and f = 10 N.

    By Model Exchange: in its Co-Simulation Euler steps as long as the communication's grow without bound.
    """
    signals = ran["Mass_Damper_me"].signals
    t, y = signals["time"], signals["plant.y"]
    c, d, f = 1e4, 10.0, 10.0
    rest, omega = f / c - 0.5, np.sqrt(c - d * d / 4)
    swing = (y[0] - rest) * np.exp(-d / 2 * t) * (np.cos(omega * t) + d / 2 / omega * np.sin(omega * t))
    assert deviation(y, rest + swing) < EXCHANGED


@pytest.mark.parametrize("kind", ["cs", "me"])
def test_the_state_space_of_the_reference_fmus_follows_its_closed_form(kind: str, ran: Mapping[str, Ran]):
    """x' = x + u, y = x + u with u = (1, 2, 3) held; Co-Simulation makes Euler steps of 1 ms."""
    signals = ran[f"StateSpace_3_{kind}"].signals
    t = signals["time"]
    for i, u in enumerate((1.0, 2.0, 3.0), start=1):
        truth = u * (np.exp(t) if kind == "me" else 1.001 ** np.round(t / 1e-3))
        assert deviation(signals[f"plant.y[{i}]"], truth) < (1e-7 if kind == "me" else 1e-12)


def test_the_fmu_of_pythonfmu_makes_its_euler_steps(ran: Mapping[str, Ran]):
    one = ran["Follower_cs"]
    n = np.arange(len(one.signals["time"]))
    assert deviation(one.signals["plant.x"], 1.0 + (1.0 - 0.5 * one.asked.step) ** n) < 1e-13  # a rounding a step


@pytest.mark.parametrize("kind", ["cs", "me"])
def test_the_fmu_of_pythonfmu3_decays(kind: str, ran: Mapping[str, Ran]):
    one = ran[f"Decay_{kind}"]
    t = one.signals["time"]
    n = np.arange(len(t))
    truth = (1.0 - one.asked.step) ** n if kind == "cs" else np.exp(-t)
    assert deviation(one.signals["plant.x"], truth) < (1e-13 if kind == "cs" else 1e-7)


def test_the_older_fmu_of_pythonfmu3_counts_its_steps_and_turns_its_array(ran: Mapping[str, Ran]):
    """It adds 1 to its output and rolls its array (0, 1, 2, 3, 4) by one a step."""
    signals = ran["FMU3Model_cs"].signals
    n = np.arange(len(signals["time"]))
    assert np.array_equal(signals["plant.output"], 3.0 + n)
    for place in range(5):
        assert np.array_equal(signals[f"plant.vector[{place + 1}]"], (place - n) % 5)


@pytest.mark.slow
def test_check_puts_its_probes_to_all_of_them(tmp_path: Path):
    folder = tmp_path / "fmus"
    folder.mkdir()
    for one in TRIES:
        (folder / f"{one.name}.fmu").write_bytes(path_of(one.name, tmp_path).read_bytes())
    command = [sys.executable, "-m", "harness", "check", str(folder), "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    found = {Path(one["fmu"]).stem: one for one in json.loads(result.stdout)["fmus"]}
    assert found.keys() == {one.name for one in TRIES}
    for name, one in found.items():
        passed = {probe["name"]: probe["passed"] for probe in one["probes"]}
        print(name, [probe for probe, outcome in passed.items() if outcome is False])
        assert one["runnable"] and any(outcome is True for outcome in passed.values()), name
