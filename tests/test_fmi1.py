"""Co-Simulation FMUs of FMI 1.0 run, and every status ends as that standard says; Model Exchange: test_exchange.py."""

from __future__ import annotations

import ctypes
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fmus.component import DISCARD, ERROR, FATAL, StepError
from fmus.description import describe
from fmus.fmu import FmuComponent, load_fmu
from fmus.toolchain import compile_shared, library_suffix, native_platform

# Speeds travel in rpm: FMI 1 only names its units.
_VARIABLES = """
mode  0 parameter Integer start="0"
label 0 parameter String  start="a%b"
u     0 input     Real    start="60" unit="rpm"
n     1 input     Integer start="7"
b     0 input     Boolean start="true"
y     1 output    Real    unit="rpm"
sum   2 output    Real
n_out 2 output    Integer
b_out 1 output    Boolean
"""
_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="relay" modelIdentifier="relay" guid="{{relay}}" version="{marker}"
 numberOfContinuousStates="0" numberOfEventIndicators="0">
<UnitDefinitions><BaseUnit unit="rpm"/></UnitDefinitions>
<ModelVariables>{variables}</ModelVariables>
<Implementation><CoSimulation_StandAlone><Capabilities canHandleVariableCommunicationStepSize="true"
 canHandleEvents="true"/></CoSimulation_StandAlone></Implementation></fmiModelDescription>
"""


def fmi1_fmu(folder: Path, marker: int) -> Path:
    """The FMU in a new folder; one with another `marker` is another FMU, whose library notes calls of its own."""
    written = []
    for line in _VARIABLES.strip().splitlines():
        name, reference, causality, kind, *attributes = line.split()
        varies = "parameter" if causality == "parameter" else "continuous" if kind == "Real" else "discrete"
        role = "internal" if causality == "parameter" else causality
        written.append(
            f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{role}" variability="{varies}">'
            f"<{kind} {' '.join(attributes)}/></ScalarVariable>"
        )
    path = folder / f"relay{marker}.fmu"
    library = compile_shared(Path(__file__).with_name("fmi1_slave.c").read_text(encoding="utf-8"))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _XML.format(marker=marker, variables="".join(written)))
        archive.write(library, f"binaries/{native_platform()}/relay{library_suffix()}")
    return path


def run(component: FmuComponent, steps: int) -> dict[str, float]:
    u = np.array([6.0, 3.0, 1.0])
    y = component.start(0.0, u)
    for k in range(steps):
        y = component.step(k * 0.1, 0.1, u)
    return dict(zip((signal.name for signal in component.outputs), y, strict=True))


def calls(component: FmuComponent) -> str:
    noted = (ctypes.c_char * 4096).in_dll(ctypes.CDLL(str(component.description.library)), "calls")
    return noted.value.decode()


def test_an_fmi_1_slave_runs_with_all_its_types_and_in_si_units(tmp_path: Path):
    description = describe(fmi1_fmu(tmp_path, 1))
    assert (description.fmi_version, description.kinds, description.reasons) == ("1.0", ("cs",), ())
    assert description.capabilities["canHandleEvents"] is True and description.cautions == ()
    component = load_fmu(fmi1_fmu(tmp_path, 1))
    y = run(component, 10)
    # There and back between rad/s and rpm: two roundings; a sum of ten.
    assert y["y"] == pytest.approx(6.0, rel=1e-15)
    assert y["sum"] == pytest.approx(6.0 * 30 / np.pi, rel=1e-14)
    assert (y["n_out"], y["b_out"]) == (3.0, 1.0)
    assert component.applied_starts == {"mode": 0.0, "label": "a%b"}
    component.close()


def test_the_calls_come_in_the_order_of_the_standard(tmp_path: Path):
    component = load_fmu(fmi1_fmu(tmp_path, 2))
    run(component, 2)
    assert calls(component) == "I" + "ss" + "sss" + "[l" + "ggg" + "sssDggg" * 2
    noted = calls(component)
    component.close()
    assert calls(component) == noted + "TF"


def test_messages_are_formatted_and_kept_and_not_printed(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    one, other = load_fmu(fmi1_fmu(tmp_path, 3), name="one"), load_fmu(fmi1_fmu(tmp_path, 3), name="other")
    run(one, 1)
    run(other, 1)
    assert [m.text for m in one.log] == [m.text for m in other.log] == ["text a%b", "from 0.0"]
    one.close()
    other.close()
    assert capfd.readouterr() == ("", "")


def test_a_warning_is_no_failure(tmp_path: Path):
    component = load_fmu(fmi1_fmu(tmp_path, 4), starts={"mode": 1})
    run(component, 5)
    component.close()


@pytest.mark.parametrize(
    ("mode", "status", "message", "last"),
    [
        (2, DISCARD, r"done up to t = 0\.25 s: step 3 is too long", "TF"),
        (3, ERROR, r"lost at 0\.20", "F"),
        (4, FATAL, r"gone", ""),
        (5, ERROR, r"doing the step", "F"),
    ],
)
def test_a_status_ends_the_run_as_the_standard_says(tmp_path: Path, mode: int, status: int, message: str, last: str):
    component = load_fmu(fmi1_fmu(tmp_path, 10 + mode), starts={"mode": mode}, name="plant")
    with pytest.raises(StepError, match=message) as raised:
        run(component, 5)
    assert (raised.value.status, raised.value.part, raised.value.time) == (status, "plant", 0.2)
    noted = calls(component)
    component.close()
    assert calls(component) == noted + last


def test_a_refused_instance_and_a_failed_initialisation_tell_why(tmp_path: Path):
    component = load_fmu(fmi1_fmu(tmp_path, 20), name="unwanted")
    with pytest.raises(StepError, match="no licence for unwanted"):
        run(component, 0)
    component.close()
    component = load_fmu(fmi1_fmu(tmp_path, 21), starts={"mode": 9})
    with pytest.raises(StepError, match=r"fmiInitializeSlave: from 0\.0"):
        run(component, 0)
    component.close()
