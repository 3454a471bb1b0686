"""Our systems elsewhere: FMPy's and ecos' importers run them as FMUs side by side, and the way back gives the same."""

from __future__ import annotations

import re
import shlex
import sys
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import etree
from numpy.typing import NDArray
from side_by_side import side_by_side
from third_party import OPENMODELICA, reference_fmu, third_party_fmu

from fmus.component import ConfigurationError, Signal
from fmus.fmu import load_fmu
from fmus.toolchain import native_platform
from fmus.units import parse_unit
from harness.campaign import Campaign, read_campaign
from harness.cli import main
from harness.clock import Pace, TimeGrid
from harness.faults import Sampling
from harness.findings import Findings
from harness.places import Places
from harness.points import Horizon
from harness.record import Record
from harness.run import run
from harness.scenario import SensorPart
from harness.sensor import build_sensor
from harness.source import build_source
from harness.sourcepart import SourcePart
from harness.ssp.exporting import Exported, export_case
from harness.ssp.importing import import_system
from harness.ssp.reading import read_structure
from harness.ssp.sensormodel import sensor_model
from harness.ssp.sourcemodel import source_model
from harness.ssp.writing import Version
from harness.wiring import wire

STEP = 1e-3
# A plant, a sensor that lags, and an observer; the torque steps at 50 ms, so that all but it is at rest until then.
DRIVE = """\
campaign: drive
description: a driveline, its encoder and an observer
clock: {time: {step: 1 ms, stop: 0.3 s}}
parts:
  torque: {use: source, unit: N.m, step: {at: 50 ms, from: 0 N.m, to: -10 N.m}}
  plant: {use: fmus.plants.driveline, with: {k: 1600 N.m/rad}, wires: {T_eng: torque}}
  encoder: {use: sensor, of: plant.y, lag: 2 ms, gain: 1.01}
  observer:
    use: observers.luenberger
    with:
      plant: fmus.plants.driveline
      location: 2
      start: {theta_e: 5 mrad, omega_c: 0.5 rad/s}
      delay: 20 ms
      dwell: 100 ms
      rate: 5 1/s
    wires: {y: encoder, T_eng: torque}
"""
WIRES = [
    ("torque", "value", "plant", "T_eng"),
    ("plant", "y", "encoder", "of"),
    ("encoder", "value", "observer", "y"),
    ("torque", "value", "observer", "T_eng"),
]


def campaign(folder: Path, text: str = DRIVE, overrides: Sequence[str] = ()) -> Campaign:
    (folder / "campaign.yaml").write_text(text)
    return read_campaign(folder / "campaign.yaml", overrides)


def exported(folder: Path, text: str = DRIVE, version: Version = "1.0", overrides: Sequence[str] = ()) -> Exported:
    asked = campaign(folder, text, overrides)
    return export_case(asked, asked.cases[0], folder / "out.ssp", version)


def refused(folder: Path, text: str, version: Version = "1.0") -> list[str]:
    with pytest.raises(ConfigurationError) as told:
        exported(folder, text, version)
    assert not (folder / "out.ssp").exists(), "nothing is written"
    return [problem.message for problem in told.value.problems]


def record(asked: Campaign) -> Record:
    with wire(asked.cases[0].scenario, asked.cases[0].places) as system:
        found = run(system)
    assert found.outcome == "ok", found.message
    return found


def columns(found: Record) -> dict[str, NDArray[np.float64]]:
    """The signals of a record in their declared units."""
    return {
        signal.name: (found.values[:, j] - parse_unit(signal.unit).offset) / parse_unit(signal.unit).factor
        for j, signal in enumerate(found.signals)
    }


def unpacked(path: Path, folder: Path) -> dict[str, Path]:
    """The FMUs of an SSP by part."""
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    return {fmu.stem: fmu for fmu in folder.glob("resources/*.fmu")}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """DRIVE as an SSP 1.0."""
    return exported(tmp_path_factory.mktemp("drive")).path


def steps_later(theirs: NDArray[np.float64], ours: NDArray[np.float64], late: int) -> float:
    """The largest difference of two signals at the instants 0, h, 2 h ..., theirs so many steps late."""
    return float(np.abs(theirs[late:] - ours[: len(theirs) - late]).max())


def test_fmpys_own_importer_runs_it_and_gives_what_its_fmus_give_side_by_side(drive: Path, tmp_path: Path):
    """FMPy adds up its times, and gives the inputs 0 in the first step, which they are here but for the observer's.

    Differences are the roundings of the time in a sampled observer and in the source.
    """
    from fmpy.ssp.simulation import simulate_ssp

    theirs = simulate_ssp(str(drive), stop_time=0.3 - 0.5 * STEP, step_size=STEP)
    oracle = side_by_side(unpacked(drive, tmp_path), WIRES, STEP, 300, watched=[("observer", "theta_e")])
    assert len(theirs) == 300
    for name, column in oracle.items():
        # A row of FMPy's has the time of the step's begin and the outputs of its end.
        assert np.abs(theirs[name] - column[1:]).max() <= 1e-9 * np.abs(column).max(), name
        assert np.ptp(column[60:]) > 0.0 or name == "torque.value"


def test_what_others_give_is_our_record_a_step_later_for_every_wire_read_in_the_same_instant(
    drive: Path, tmp_path: Path
):
    """The plant is fed as here, the encoder reads it a step late, with the same arithmetic: to the last digits.

    What the observer reads is two steps late and its torque is not, so it is another run of it: bounded only.
    """
    ours = columns(record(campaign(tmp_path)))
    theirs = side_by_side(unpacked(drive, tmp_path), WIRES, STEP, 300, watched=[("observer", "theta_e")])
    assert steps_later(theirs["plant.y"], ours["plant.y"], 0) <= 1e-12 * np.abs(ours["plant.y"]).max()
    assert steps_later(theirs["encoder.value"], ours["encoder.value"], 1) <= 1e-12 * np.abs(ours["plant.y"]).max()
    late = np.abs(np.diff(ours["encoder.value"])).max() * 2.0  # how far a reading is off that is two steps late
    wrong = steps_later(theirs["observer.theta_e"], ours["observer.theta_e"], 0)
    assert 0.0 < wrong < 0.2 * late * np.ptp(ours["observer.theta_e"])


def test_what_is_said_of_the_order_is_that(tmp_path: Path):
    notes = exported(tmp_path).notes
    assert notes == (
        "read in the same instant here, a step later by tools that step all FMUs side by side: "
        "plant.y -> encoder.of, encoder.value -> observer.y",
    )


@pytest.mark.parametrize("version", ["1.0", "2.0"])
def test_the_way_back_gives_the_same_bytes(version: Version, tmp_path: Path):
    """Sources and sensors come back as they were, FMUs in their old order with their old roles."""
    text = DRIVE.replace("lag: 2 ms", "lag: 2 ms, delay: 3 ms, every: 2 ms, faults: [{drift: 2 rpm, from: 60 ms}]")
    text = text.replace("use: observers.luenberger", "use: observers.luenberger\n    every: 2 ms")
    made = exported(tmp_path, text, version)
    assert "observer samples every 2.0 ms itself: it is stepped as often as all others" in made.notes
    assert read_structure(made.path).version == version
    back = read_campaign(import_system(made.path).write(tmp_path / "back"))
    assert [(part, spec.use) for part, spec in back.cases[0].scenario.parts.items()] == [
        ("torque", "source"), ("plant", "resources/plant.fmu"), ("encoder", "sensor"),
        ("observer", "resources/observer.fmu"),
    ]  # fmt: skip
    one, other = record(campaign(tmp_path, text)), record(back)
    assert [signal.name for signal in one.signals] == [signal.name for signal in other.signals]
    assert np.array_equal(one.values, other.values) and np.array_equal(one.time, other.time)
    assert (one.order, one.held) == (other.order, other.held)


def test_the_same_case_gives_the_same_archive(tmp_path: Path):
    one, other = (exported(tmp_path).path.read_bytes() for _ in range(2))
    assert one == other


def test_values_changed_by_another_tool_are_taken_and_the_element_is_its_fmu_then(drive: Path, tmp_path: Path):
    changed = tmp_path / "changed.ssp"
    with zipfile.ZipFile(drive) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            content = old.read(name)
            if name == "SystemStructure.ssd":
                root = etree.fromstring(content)
                spaces = {key: value for key, value in root.nsmap.items() if key} | {
                    "ssv": "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
                }
                (torque,) = root.xpath("//ssd:Component[@name='torque']", namespaces=spaces)
                bindings = etree.fromstring(
                    f"<ssd:ParameterBindings xmlns:ssd='{spaces['ssd']}' xmlns:ssv='{spaces['ssv']}'>"
                    "<ssd:ParameterBinding><ssd:ParameterValues>"
                    "<ssv:ParameterSet version='1.0' name='x'><ssv:Parameters>"
                    "<ssv:Parameter name='to'><ssv:Real value='-20'/></ssv:Parameter></ssv:Parameters>"
                    "</ssv:ParameterSet></ssd:ParameterValues></ssd:ParameterBinding></ssd:ParameterBindings>"
                )
                torque.insert(1, bindings)
                content = etree.tostring(root)
            new.writestr(name, content)
    back = read_campaign(import_system(changed).write(tmp_path / "back"))
    torque_part = back.cases[0].scenario.parts["torque"]
    assert torque_part.use == "resources/torque.fmu"
    assert columns(record(back))["torque.value"][-1] == -20.0


def test_an_fmu_of_another_tool_goes_along_as_it_is_with_its_values_and_units(tmp_path: Path):
    fmu = third_party_fmu("MassSpringSubSystem1.fmu", OPENMODELICA)
    text = f"""\
campaign: half
clock: {{time: {{step: 10 ms, stop: 1 s}}}}
parts:
  one: {{use: source, unit: N/m, constant: 1 N/m}}
  mass: {{use: source, unit: kg, constant: 2 kg}}
  wall: {{use: source, unit: mm, sine: {{amplitude: 100 mm, mean: 0 mm, frequency: 1 Hz}}}}
  half:
    use: {fmu}
    units: {{x1: mm, x2: mm, m1: kg, k1: N/m, k2: N/m}}
    wires: {{k1: one, k2: one, m1: mass, x2: wall}}
  other: {{use: {reference_fmu("VanDerPol")}, with: {{mu: 3}}}}
"""
    made = exported(tmp_path, text)
    assert unpacked(made.path, tmp_path / "in")["half"].read_bytes() == fmu.read_bytes()
    found = read_structure(made.path)
    assert found.system.elements["half"].connectors["x1"].unit.name == "mm"
    (given,) = found.system.elements["other"].assignments
    assert (given.name, given.value.values) == ("mu", (3.0,))
    one, other = record(campaign(tmp_path, text)), record(read_campaign(import_system(made.path).write(tmp_path / "b")))
    assert np.array_equal(one.values, other.values)


def test_a_connection_between_two_units_converts_in_so_many_words(tmp_path: Path):
    """Of FMUs whose units differ; a source takes over the unit of what it feeds, so that it needs none."""
    (tmp_path / "turning.py").write_text(
        "from fmus.component import Signal\nfrom fmus.model import Model\n"
        "def model(name, one, other):\n"
        "    return Model(name=name, description='', equations=lambda t, x, m, u, p: ({}, {'y': u.u}),\n"
        "                 inputs=(Signal('u', one),), outputs=(Signal('y', other),))\n"
        "RPM = model('in_rpm', 'rpm', 'rpm')\nRAD = model('in_rad', 'rad/s', 'rad/s')\n"
    )
    text = """\
campaign: units
clock: {time: {step: 10 ms, stop: 50 ms}}
parts:
  speed: {use: source, unit: rad/s, constant: 30 rad/s}
  first: {use: "turning:RPM", wires: {u: speed}}
  second: {use: "turning:RAD", wires: {u: first.y}}
"""
    made = exported(tmp_path, text)
    assert any("first.y -> second.u converts rpm to rad/s" in note for note in made.notes)
    fed, joined = read_structure(made.path).system.connections
    assert (fed.transformation, joined.suppressed) == (None, True)
    assert joined.transformation.factor == parse_unit("rpm").factor
    back = import_system(made.path)
    assert back.text.count("wires: {u: first.y}") == 1, "the same meaning is a plain wire again"
    theirs = side_by_side(
        unpacked(made.path, tmp_path / "in"), [("speed", "value", "first", "u")], 0.01, 3, watched=[("first", "y")]
    )
    assert theirs["first.y"][-1] == pytest.approx(30.0 / parse_unit("rpm").factor, rel=1e-15)


def test_a_source_of_whole_numbers_or_truth_values_gives_such(tmp_path: Path):
    text = f"""\
campaign: kinds
clock: {{time: {{step: 0.1 s, stop: 1 s}}}}
parts:
  number: {{use: source, unit: "1", step: {{at: 0.5 s, from: 1, to: 2}}}}
  truth: {{use: source, unit: "1", step: {{at: 0.5 s, from: 0, to: 1}}}}
  real: {{use: source, unit: "1", constant: 2.5}}
  through:
    use: {reference_fmu("Feedthrough")}
    wires:
      Float64_continuous_input: real
      Float64_discrete_input: real
      Int32_input: number
      Boolean_input: truth
      Enumeration_input: number
"""
    made = exported(tmp_path, text)
    elements = read_structure(made.path).system.elements
    types = [elements[name].connectors["value"].type for name in ("number", "truth", "real")]
    assert types == ["Integer", "Boolean", "Real"]
    wires = [("number", "value", "through", "Int32_input"), ("truth", "value", "through", "Boolean_input")]
    watched = [("through", "Int32_output"), ("through", "Boolean_output")]
    theirs = side_by_side(unpacked(made.path, tmp_path / "in"), wires, 0.1, 10, watched=watched)
    ours = columns(record(campaign(tmp_path, text)))
    for name in ("through.Int32_output", "through.Boolean_output"):
        assert np.array_equal(theirs[name][1:], ours[name][1:]) and len(set(ours[name])) == 2


# ---- sources and sensors as FMUs ----

SOURCES: Mapping[str, dict[str, Any]] = {
    "constant": {"unit": "degC", "constant": "20 degC"},
    "step": {"unit": "N.m", "step": {"at": "0.2 s", "from": "1 N.m", "to": "-3 N.m"}},
    "ramp": {"unit": "rpm", "ramp": {"at": "0.1 s", "until": "0.5 s", "from": "100 rpm", "to": "50 rpm"}},
    "sine": {
        "unit": "rpm",
        "sine": {"amplitude": "3 rpm", "frequency": "2 Hz", "mean": "1 rpm", "phase": "30 deg"},
    },
    "held": {"unit": "1", "table": {"time": ["0.1 s", "0.3 s", "0.7 s"], "value": [1, -2, 5]}},
    "repeated": {"unit": "1", "table": {"time": ["0 s", "0.1 s", "0.3 s"], "value": [1, -2, 5], "ends": "repeat"}},
    "lines repeated": {
        "unit": "1",
        "table": {"time": ["0.1 s", "0.2 s", "0.4 s"], "value": [1, -2, 5], "ends": "repeat", "between": "linear"},
    },
    "swept": {
        "unit": "rpm",
        "chirp": {
            "amplitude": "3 rpm",
            "from": "1 Hz",
            "to": "4 Hz",
            "duration": "0.6 s",
            "mean": "1 rpm",
            "begin": "0.1 s",
            "phase": "30 deg",
        },
    },
    "swept evenly": {
        "unit": "rpm",
        "chirp": {
            "amplitude": "3 rpm",
            "from": "1 Hz",
            "to": "4 Hz",
            "duration": "0.6 s",
            "mean": "1 rpm",
            "sweep": "logarithmic",
        },
    },
    "many points": {
        "unit": "km/h",
        "table": {
            "time": [f"{k / 300} s" for k in range(301)],
            "value": [f"{50.0 + 40.0 * np.sin(0.07 * k)} km/h" for k in range(301)],
            "between": "linear",
        },
    },
    "lines": {
        "unit": "bar",
        "table": {"time": ["0.1 s", "0.3 s", "0.7 s"], "value": ["1 bar", "-2 bar", "5 bar"], "between": "linear"},
    },
}


@pytest.mark.parametrize("kind", SOURCES)
def test_the_fmu_of_a_source_is_at_each_instant_what_the_source_holds_from_there(kind: str, tmp_path: Path):
    from fmus.export import build_fmu

    spec, found = SourcePart.model_validate({"use": "source", **SOURCES[kind]}), Findings(Places())
    source = build_source(spec, Horizon(0.0, 0.95, 1.0, 5e-8), found)
    fmu = load_fmu(build_fmu(source_model(kind, spec, source, 0.0, spec.unit), tmp_path / "s.fmu"))
    assert not found.problems
    nothing = np.empty(0)
    ours, theirs = [source.start(0.0, nothing)[0]], [fmu.start(0.0, nothing)[0]]
    for k in range(1, 20):
        ours.append(source.step(k * 0.05, 0.05, nothing)[0])
        theirs.append(fmu.step((k - 1) * 0.05, 0.05, nothing)[0])
    fmu.close()
    # SI here, the source's unit in the FMU: conversions there and back round; so do angles of another formula
    assert np.abs(np.array(ours) - theirs).max() <= 1e-14 * np.abs(ours).max()
    assert np.ptp(ours) > 0.0 or kind == "constant"


SENSORS: Mapping[str, dict[str, Any]] = {
    "gain": {"gain": 2.0, "bias": "0.5 rpm"},
    "lag": {"lag": "3 ms"},
    "delay": {"delay": "2.5 ms"},
    "rounded and clipped": {"quantise": "0.25 rad/s", "limits": ["-4 rad/s", "5 rad/s"]},
    "slow and stuck": {"every": "2 ms", "faults": [{"stuck": True, "from": "20 ms", "to": "30 ms"}]},
    "all": {
        "lag": "1 ms",
        "delay": "3 ms",
        "faults": [
            {"bias": "1 rpm", "from": "5 ms", "to": "10 ms"},
            {"gain": 1.5, "from": "9 ms"},
            {"drift": "5 rpm", "from": "12 ms", "to": "40 ms"},
        ],
    },
}


@pytest.mark.parametrize("kind", SENSORS)
def test_the_fmu_of_a_sensor_reads_bit_for_bit_what_the_sensor_reads(kind: str, tmp_path: Path):
    from fmus.export import build_fmu

    spec, found = SensorPart.model_validate({"use": "sensor", "of": "a.b", **SENSORS[kind]}), Findings(Places())
    every = 2 if "every" in SENSORS[kind] else 1
    sensor = build_sensor(
        spec,
        Signal("y", "rad/s", 0.3),
        Sampling(TimeGrid(0.0, STEP, 60), Pace(every, step=every * STEP)),
        1,
        "s",
        found,
    )
    fmu = load_fmu(build_fmu(sensor_model("s", sensor, STEP, "rad/s", "rad/s"), tmp_path / "s.fmu"))
    assert not found.problems
    signal = [np.array([12.0 * np.sin(0.3 * k) + 0.125 * k]) for k in range(60)]
    ours, theirs = [sensor.start(0.0, signal[0])], [fmu.start(0.0, signal[0])]
    for k in range(1, 60):
        ours.append(sensor.step((k - every) * STEP, every * STEP, signal[k]) if k % every == 0 else ours[-1])
        theirs.append(fmu.step((k - 1) * STEP, STEP, signal[k]))
    fmu.close()
    assert np.array_equal(ours, theirs), "the reading, and the fault that acts"
    assert np.ptp(ours, axis=0).min() > 0.0


# ---- what an SSP cannot hold ----

BASE = """\
campaign: refused
clock: {time: {step: 1 ms, stop: 10 ms}}
parts:
  torque: {use: source, unit: N.m, constant: 1 N.m}
  plant: {use: fmus.plants.driveline, wires: {T_eng: torque}}
"""
REFUSED = {
    "noise": ("  s: {use: sensor, of: plant.y, noise: {std: 1 rpm}}", "s has noise or drop-out"),
    "drop-out": ("  s: {use: sensor, of: plant.y, drop_out: 0.1}", "s has noise or drop-out"),
    "a fault of noise": (
        "  s: {use: sensor, of: plant.y, faults: [{noise: 1 rpm, from: 1 ms}]}",
        "s has noise or drop-out",
    ),
    "a delay of many samples": ("  s: {use: sensor, of: plant.y, delay: 2 s}", "s is delayed by 2000 samples"),
    "a fault that delays": (
        "  s: {use: sensor, of: plant.y, faults: [{delay: 2 ms, from: 3 ms}]}",
        "s has a fault that delays",
    ),
    "a wire with faults": (
        "  s: {use: fmus.plants.driveline, wires: {T_eng: {from: torque, faults: [{gain: 2, from: 1 ms}]}}}",
        "s.wires.T_eng wants no faults to be exported",
    ),
    "a swap": (
        "  s: {use: swap, between: [plant.omega_c, plant.omega_p], from: 1 ms}",
        "s is a swap, which is not exported",
    ),
    "a part in Python": (
        "  s: {use: harness.ssp.transformations:table, with: {entries: {3: 1}}, wires: {u: plant.location}}",
        "s is Python, harness.ssp.transformations:table",
    ),
    "a plant with a period of its own": (
        "  s: {use: fmus.plants.driveline, every: 2 ms, wires: {T_eng: torque}}",
        "s.every wants no value to be exported",
    ),
    "a wire with a delay": (
        "  s: {use: fmus.plants.driveline, wires: {T_eng: {from: torque, delay: 1}}}",
        "s.wires.T_eng wants no delay to be exported",
    ),
    "a crank": ("  s: {use: crank, of: plant.theta_e}", "s is a crank, which is not exported"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_exported_faithfully_is_refused_by_name(kind: str, tmp_path: Path):
    part, message = REFUSED[kind]
    told = refused(tmp_path, BASE + part + "\n")
    assert any(one.startswith(message) for one in told), told


def test_all_that_cannot_be_exported_is_told_at_once(tmp_path: Path):
    parts = "".join(f"{part.replace('  s:', f'  s{n}:')}\n" for n, (part, _) in enumerate(REFUSED.values()))
    assert len(refused(tmp_path, BASE + parts)) == len(REFUSED)


def test_a_crank_clock_is_refused(tmp_path: Path):
    text = BASE.replace("time: {step: 1 ms, stop: 10 ms}", "crank: {step: 6 deg, stop: 60 deg, speed: plant.omega_c}")
    (told,) = refused(tmp_path, text)
    assert told == "a clock in crank angle cannot be exported: an SSP is stepped in time"


def test_the_points_of_a_file_go_along_and_come_back(tmp_path: Path):
    (tmp_path / "torque.csv").write_text("time [s],torque [N.m]\n0,1\n0.005,-2\n0.02,3\n")
    text = BASE.replace("constant: 1 N.m", "table: {file: torque.csv, value: torque, between: linear}")
    made = exported(tmp_path, text)
    assert any("torque holds its ends outside of 0 s ... 0.02 s" in note for note in made.notes)
    one, other = record(campaign(tmp_path, text)), record(read_campaign(import_system(made.path).write(tmp_path / "b")))
    assert np.array_equal(one.values, other.values) and np.ptp(one.values[:, 0]) > 0.0


def test_arrays_want_ssp_2(tmp_path: Path):
    text = f"""\
campaign: arrays
clock: {{time: {{step: 0.1 s, stop: 1 s}}}}
parts:
  u: {{use: source, unit: "1", constant: 2}}
  s: {{use: {reference_fmu("StateSpace", 3)}, wires: {{"u[1]": u, "u[2]": u, "u[3]": u}}, with: {{x0: [1, 2, 3]}}}}
  t: {{use: {reference_fmu("StateSpace", 3)}, wires: {{u: s.y}}}}
"""
    assert any("is an array, which SSP 1.0 has none of: export SSP 2.0" in one for one in refused(tmp_path, text))
    made = exported(tmp_path, text, "2.0")
    one, other = record(campaign(tmp_path, text)), record(read_campaign(import_system(made.path).write(tmp_path / "b")))
    assert np.array_equal(one.values, other.values)


# ---- the command ----


@pytest.fixture
def crankbench(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int, str, str]]:
    """Calls the command line in this process: (exit code, stdout, stderr)."""

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["crankbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        said = capsys.readouterr()
        return int(ended.value.code or 0), said.out, said.err

    return call


def test_the_command_exports_the_case_that_is_asked_for_and_tells_what_is_left_out(crankbench: Any, tmp_path: Path):
    text = DRIVE + "vary: {plant.k: [1500, 1700] N.m/rad}\nmetrics: {rest: {final: plant.y}}\n".replace(
        "[1500, 1700] N.m/rad", '"[1500, 1700] N.m/rad"'
    )
    campaign(tmp_path, text)
    out = tmp_path / "two.ssp"
    code, said, _ = crankbench("ssp", "export", tmp_path / "campaign.yaml", "--out", out, "--case", 2, "--ssp", "2.0")
    assert code == 0
    lines = said.splitlines()
    assert (lines[0], lines[-1]) == ("one case of 2: plant.k = 1700 N.m/rad", str(out))
    assert "of the campaign is left out: vary, metrics" in lines
    (given,) = read_structure(out).system.elements["plant"].assignments
    assert (given.name, given.value.values, given.value.unit.name) == ("k", (1700.0,), "N.m/rad")
    overridden = ("--set", "torque.step.to=-5 N.m")
    assert crankbench("ssp", "export", tmp_path / "campaign.yaml", "--out", out, *overridden)[0] == 0
    assert read_structure(out).system.elements["torque"].annotation["part"]["step"]["to"] == "-5.0 N.m"


def test_the_command_refuses_what_it_cannot_write_and_leaves_files_alone(crankbench: Any, tmp_path: Path):
    campaign(tmp_path)
    file = tmp_path / "campaign.yaml"
    for arguments, message in (
        (("--out", tmp_path / "x.zip"), "--out wants a file that ends in .ssp"),
        (("--out", tmp_path / "x.ssp", "--ssp", "3.0"), "--ssp wants 1.0 or 2.0, got 3.0"),
        (("--out", tmp_path / "x.ssp", "--case", 2), "--case wants 1 to 1, got 2"),
    ):
        code, _, said = crankbench("ssp", "export", file, *arguments)
        assert code == 2 and message in said
    assert crankbench("ssp", "export", file, "--out", tmp_path / "x.ssp")[0] == 0
    assert crankbench("ssp", "import", tmp_path / "x.ssp", "--out", tmp_path / "in")[0] == 0
    code, _, said = crankbench("ssp", "import", tmp_path / "x.ssp", "--out", tmp_path / "in")
    assert code == 2 and "drive.yaml is there already: give another --out, or remove it" in said


# ---- ecos ----


@pytest.mark.slow
@pytest.mark.skipif(native_platform() != "linux64", reason="ecos is for 64-bit Linux here")
def test_ecos_runs_it_as_fmus_side_by_side(drive: Path, tmp_path: Path):
    """Its importer takes the parameter sets by their name, and no unit."""
    ecospy = pytest.importorskip("ecospy", reason="wants pip install ecospy, and Debian's libtbb12", exc_type=Exception)
    names = ["torque::value", "plant::y", "encoder::value", "observer::theta_e"]
    rows = []
    with ecospy.EcosSimulation(step_size=STEP, ssp_path=str(drive)) as simulation:
        simulation.init(parameter_set="parameters")
        for _ in range(300):
            simulation.step(1)
            rows.append([simulation.get_real(name) for name in names])
    oracle = side_by_side(unpacked(drive, tmp_path), WIRES, STEP, 300, watched=[("observer", "theta_e")])
    for name, column in zip(names, np.array(rows).T, strict=True):
        wanted = oracle[name.replace("::", ".")][1:]
        assert np.abs(column - wanted).max() <= 1e-9 * np.abs(wanted).max(), name


# ---- the page ----


def test_the_commands_of_the_page_say_what_it_shows(crankbench: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    page = (Path(__file__).parent.parent / "docs" / "ssp.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (console,) = re.findall(r"```console\n(.*?)```", page, re.DOTALL)
    (tmp_path / "drive.yaml").write_text(text)
    monkeypatch.chdir(tmp_path)
    for shown in console.removeprefix("$ ").split("\n$ "):
        command, _, output = shown.partition("\n")
        name, *arguments = shlex.split(command)
        assert name == "crankbench"
        code, said, _ = crankbench(*arguments)
        assert code == 0
        assert output.rstrip("\n") in said
    one, other = (record(read_campaign(Path(file))) for file in ("drive.yaml", "drive/drive.yaml"))
    assert np.array_equal(one.values, other.values)
