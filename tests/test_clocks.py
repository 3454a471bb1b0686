"""FMI 3 clocks tick at their times, steps that return early are finished, and what cannot be ticked is told."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np
import pytest

from fmus.component import ERROR, ConfigurationError, StepError
from fmus.description import FmuKind, describe
from fmus.fmu import load_fmu
from fmus.toolchain import FMI3_PLATFORMS, compile_shared, library_suffix, native_platform

_PERIOD = 'intervalVariability="constant" intervalDecimal="0.3" shiftDecimal="0.1"'
_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="clocked" instantiationToken="{{clocked}}">
<ModelExchange modelIdentifier="clocked" canGetAndSetFMUState="true"/>
<CoSimulation modelIdentifier="clocked" hasEventMode="{events}" canGetAndSetFMUState="true"/>
<ModelVariables>
<Float64 name="time" valueReference="0" causality="independent" variability="continuous"/>
<Float64 name="u" valueReference="1" causality="input" start="0"/>
<Float64 name="x" valueReference="2" causality="output" initial="calculated"/>
<Float64 name="ticks" valueReference="3" causality="output" variability="discrete"/>
<Float64 name="last_tick" valueReference="4" causality="output" variability="discrete"/>
<Float64 name="passed" valueReference="5" causality="output" variability="discrete"/>
<Float64 name="events" valueReference="6" causality="output" variability="discrete"/>
<Float64 name="der(x)" valueReference="7" causality="local" derivative="2"/>
<Clock name="clock" valueReference="8" causality="input" {clock}/>
<Float64 name="stuck" valueReference="9" causality="parameter" variability="fixed" start="0"/>
</ModelVariables>
<ModelStructure><Output valueReference="2"/><Output valueReference="3"/><Output valueReference="4"/>
<Output valueReference="5"/><Output valueReference="6"/>
<ContinuousStateDerivative valueReference="7"/></ModelStructure></fmiModelDescription>
"""


def clock_fmu(folder: Path, clock: str = _PERIOD, events: bool = True) -> Path:
    """The FMU in a new folder, with a clock so declared, and with or without an event mode in Co-Simulation."""
    path = folder / "clocked.fmu"
    library = compile_shared(Path(__file__).with_name("clock_fmu.c").read_text(encoding="utf-8"))
    place = FMI3_PLATFORMS.get(native_platform(), native_platform())
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _XML.format(clock=clock, events=str(events).lower()))
        archive.write(library, f"binaries/{place}/clocked{library_suffix()}")
    return path


@pytest.mark.parametrize("kind", ["cs", "me"])
@pytest.mark.parametrize("h", [0.1, 0.25, 1.0])
def test_a_clock_ticks_at_its_times_whatever_the_step(tmp_path: Path, kind: FmuKind, h: float):
    component = load_fmu(clock_fmu(tmp_path), kind=kind)
    names = [signal.name for signal in component.outputs]
    y = dict(zip(names, component.start(0.0, np.zeros(1)), strict=True))
    assert y["ticks"] == 0
    for k in range(round(2 / h)):
        y = dict(zip(names, component.step(k * h, h, np.zeros(1)), strict=True))
        ticks = math.floor(((k + 1) * h - 0.1) / 0.3 + 1e-9) + 1
        assert y["ticks"] == max(ticks, 0)
        if ticks > 0:  # a multiple of the interval, rounded a few times at 2 s
            assert y["last_tick"] == pytest.approx(0.1 + 0.3 * (ticks - 1), abs=1e-14)
    component.close()


def test_a_counted_interval_is_read_with_its_resolution(tmp_path: Path):
    counted = 'intervalVariability="fixed" supportsFraction="true" resolution="1000" intervalCounter="250"'
    (clock,) = describe(clock_fmu(tmp_path, counted)).clocks
    assert (clock.interval, clock.shift, clock.ticked) == (0.25, 0.0, True)


def test_a_step_that_returns_early_is_finished_after_its_event(tmp_path: Path):
    component = load_fmu(clock_fmu(tmp_path))
    names = [signal.name for signal in component.outputs]
    u = np.array([0.8])
    component.start(0.0, u)
    component.step(0.0, 1.0, u)
    y = dict(zip(names, component.step(1.0, 1.0, u), strict=True))
    component.close()
    assert y["passed"] == pytest.approx(1 / 0.8, rel=1e-14)  # some roundings
    assert y["x"] == pytest.approx(1.6, rel=1e-14)
    # One round at the start, two at each of the seven ticks, one where x passes 1.
    assert y["events"] == 1 + 7 * 2 + 1


def test_a_step_that_never_gets_on_is_an_error(tmp_path: Path):
    component = load_fmu(clock_fmu(tmp_path), starts={"stuck": 1.0}, name="plant")
    component.start(0.0, np.zeros(1))
    with pytest.raises(StepError, match="does not get on: the FMU returns early each time at t = 0 s") as raised:
        component.step(0.0, 1.0, np.zeros(1))
    assert raised.value.status == ERROR
    component.close()


@pytest.mark.parametrize(
    ("clock", "reason"),
    [
        ('intervalVariability="countdown"', "its clock clock wants ticks at times that change as it runs (countdown)"),
        ('intervalVariability="fixed"', "its clock clock does not say in its description how often it ticks"),
    ],
)
def test_a_clock_that_cannot_be_ticked_is_a_reason(tmp_path: Path, clock: str, reason: str):
    description = describe(clock_fmu(tmp_path, clock))
    assert description.reasons == (reason,)
    with pytest.raises(ConfigurationError, match="clock"):
        load_fmu(clock_fmu(tmp_path, clock))


def test_a_clock_without_an_event_mode_is_a_reason_in_co_simulation_alone(tmp_path: Path):
    description = describe(clock_fmu(tmp_path, events=False))
    assert description.reasons == ("it has clocks that want ticks, but no event mode to tick them in",)
    assert description.run_as("me").runnable


def test_a_triggered_clock_stays_still_and_is_a_caution(tmp_path: Path):
    description = describe(clock_fmu(tmp_path, 'intervalVariability="triggered"'))
    assert description.runnable
    assert "its triggered clocks are never ticked: clock" in description.cautions
