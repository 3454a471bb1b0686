"""What a loaded FMU is told and asked, in which units, and what becomes of it when a step goes wrong."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from echo_fmu import calls_on, echo_fmu

from fmus.component import DISCARD, ERROR, FATAL, ConfigurationError, StepError
from fmus.fmu import FmuComponent, load_fmu

RPM = 2 * math.pi / 60


def run(component: FmuComponent, steps: int) -> None:
    u = np.array([signal.start for signal in component.inputs])
    component.start(0.0, u)
    for k in range(steps):
        component.step(k * 0.1, 0.1, u)


def calls(component: FmuComponent) -> str:
    return calls_on(component.description.library).decode()


def test_values_pass_in_si_units_whatever_the_fmu_keeps(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 1), starts={"idle": 900 * RPM})
    units = {signal.name: signal.unit for signal in component.inputs}
    assert units == {
        "speed": "rpm",
        "count": "1",
        "temperature": "degC",
        "flag": "1",
        "road": "m/s",  # the FMU defines it, this project does not know it by name
        "rise": "K",  # a difference of temperatures
        "torque": "N.m",  # the FMU names it without saying what it is
        "wish": "",  # nobody says what it is
        "bare": "",
    }
    u = np.array([100.0, 3.0, 300.0, 0.0, 10.0, 4.0, 2.5, 8.0, 9.0])
    component.start(0.0, u)
    y = dict(zip((signal.name for signal in component.outputs), component.step(0.0, 0.1, u), strict=True))
    component.close()
    # There and back is a division and a multiplication: two roundings, and those of the offset's size.
    back = [value for name, value in y.items() if not name.startswith("raw")]
    assert np.allclose(back, u, rtol=1e-15, atol=1e-13)
    assert y["raw_speed"] == 100.0 / RPM
    assert y["raw_temperature"] == 300.0 - 273.15
    assert y["raw_idle"] == pytest.approx(900.0, rel=1e-15)
    assert component.applied_starts == {"mode": 0.0, "label": "a b", "idle": y["raw_idle"]}


def test_signals_declare_starts_in_their_unit(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 1), starts={"speed": 30 * RPM})
    starts = {signal.name: signal.start for signal in component.inputs}
    component.close()
    assert starts["speed"] == pytest.approx(30.0, rel=1e-15)
    assert starts["temperature"] == 20.0
    assert starts["road"] == pytest.approx(2 * 1.543333, rel=1e-15)
    assert starts["flag"] == 1.0


def test_a_start_value_out_of_its_range_is_told_in_the_unit_of_the_fmu(tmp_path: Path):
    with pytest.raises(ConfigurationError, match=r"echo.idle wants 500 to 1200 rpm, got 2000"):
        load_fmu(echo_fmu(tmp_path, 1), starts={"idle": 2000 * RPM})
    with pytest.raises(ConfigurationError, match=r"echo.mode wants a whole number, got 1.5"):
        load_fmu(echo_fmu(tmp_path, 1), starts={"mode": 1.5})


def test_a_run_makes_the_calls_in_the_order_of_the_standard(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 2))
    run(component, 2)
    # One call a type: reals, integers and booleans are set, and got.
    assert calls(component) == "Ixss[sss]ggg" + "sssDggg" * 2
    noted = calls(component)
    component.close()
    assert calls(component) == noted + "TF"


def test_unwired_inputs_and_unread_outputs_cost_no_calls(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 3))
    component.hold_inputs(["count", "flag"])
    component.select_outputs(["torque_out"])
    run(component, 2)
    assert calls(component) == "Ixss[sss]g" + "sDg" * 2
    component.close()


def test_a_warning_is_no_failure(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 4), starts={"mode": 1})
    run(component, 5)
    component.close()


def test_a_discard_tells_how_far_the_step_came(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 5), starts={"mode": 2}, name="plant")
    with pytest.raises(StepError) as raised:
        run(component, 5)
    assert (raised.value.status, raised.value.part) == (DISCARD, "plant")
    assert raised.value.message == "doing the step, done up to t = 0.25 s: step 3 of 0.1 s is too long"
    noted = calls(component)
    component.close()
    assert calls(component) == noted + "TF"


def test_after_an_error_the_instance_is_freed_and_nothing_else(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 6), starts={"mode": 3})
    with pytest.raises(StepError, match=r"doing the step: lost at 0\.20") as raised:
        run(component, 5)
    assert raised.value.status == ERROR
    noted = calls(component)
    with pytest.raises(StepError):
        component.step(0.3, 0.1, np.zeros(9))
    component.close()
    assert calls(component) == noted + "F"


def test_after_a_fatal_no_call_is_made_on_any_instance(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 7), starts={"mode": 4})
    with pytest.raises(StepError, match="doing the step: gone") as raised:
        run(component, 5)
    assert raised.value.status == FATAL
    noted = calls(component)
    with pytest.raises(StepError) as again:
        component.step(0.3, 0.1, np.zeros(9))
    assert again.value.status == FATAL
    component.close()
    another = load_fmu(echo_fmu(tmp_path, 7))
    with pytest.raises(StepError, match="reported fatal") as refused:
        another.start(0.0, np.zeros(9))
    assert refused.value.status == FATAL
    another.close()
    assert calls(component) == noted


def test_a_step_left_pending_is_an_error(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 8), starts={"mode": 5})
    with pytest.raises(StepError) as raised:
        run(component, 5)
    assert raised.value.status == ERROR
    component.close()


def test_a_failed_initialisation_frees_the_instance_and_tells_the_call(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 9), starts={"mode": 9})
    with pytest.raises(StepError, match="fmi2EnterInitializationMode"):
        run(component, 0)
    assert calls(component) == "Ixss["
    component.close()
    assert calls(component) == "Ixss[F"


def test_a_refused_instance_tells_the_fmus_reason(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 10), name="unwanted")
    with pytest.raises(StepError, match="no licence for unwanted"):
        run(component, 0)
    component.close()


def test_messages_are_formatted_filed_under_their_time_and_not_printed(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    component = load_fmu(echo_fmu(tmp_path, 11), starts={"mode": 3})
    with pytest.raises(StepError):
        run(component, 5)
    assert component.log[0] == (0.0, 0, "set-up", "logStatusError on")  # the one category about statuses it declares
    assert component.log[1] == (0.0, 0, "set-up", "text a b")
    assert component.log[-1] == (0.2, ERROR, "logStatusError", "lost at 0.20")
    component.start(0.0, np.zeros(9))
    assert [message.category for message in component.log] == ["set-up", "set-up"]
    component.close()
    assert capfd.readouterr() == ("", "")


def test_the_log_keeps_the_first_and_the_last_messages_and_counts_the_others(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 12), starts={"mode": 6})
    run(component, 4)
    texts = [message.text for message in component.log]
    assert texts[2:64] == [f"message {k}" for k in range(62)]
    assert texts[64:] == [f"message {k}" for k in range(1000 - 192, 1000)]
    assert component.log_dropped == 1002 - 256
    component.close()


def test_odd_messages_do_no_harm(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 13), starts={"mode": 7})
    run(component, 4)
    assert [message.text for message in component.log[-2:]] == ["100 %% %n", "half done: 50%"]
    component.close()


def test_a_message_too_long_is_cut_visibly(tmp_path: Path):
    component = load_fmu(echo_fmu(tmp_path, 14), starts={"mode": 8})
    run(component, 4)
    text = component.log[-1].text
    assert text == "x" * (1023 - len(" [...]")) + " [...]"
    component.close()
