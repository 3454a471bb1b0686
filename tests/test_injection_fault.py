"""The plant that makes injectors go wrong: which, from when on, by how much, and what is true."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from filtered import Filter
from fmpy.validation import validate_fmu
from hypothesis import given
from hypothesis import strategies as st

from fmus.component import ConfigurationError
from fmus.jacobians import point
from fmus.model import FlatModel
from fmus.plants.crank_engine_signals import FIRING_ORDER
from fmus.plants.injection_fault import CYLINDERS, MODEL
from harness.building import Export, build_model

BEGIN = 7200.0  # deg
OUTPUTS = [signal.name for signal in MODEL.outputs]


def source(angle: float, **parameters: float) -> dict[str, float]:
    """What the Python source gives at a crank angle [deg], by name."""
    at = point(MODEL, {"angle": angle, "begin": BEGIN, **parameters})
    _, y = FlatModel(MODEL).derivatives_and_outputs(0.0, [], [], list(at.u), list(at.p))
    return dict(zip(OUTPUTS, map(float, y), strict=True))


def fires_a_turn_later(cylinder: int) -> int:
    """The cylinder that fires 360 deg after this one: two places on in the firing order."""
    return FIRING_ORDER[(FIRING_ORDER.index(cylinder) + 2) % len(FIRING_ORDER)]


@pytest.mark.parametrize("cylinder", CYLINDERS)
@pytest.mark.parametrize("amount", [-1.0, -0.02, 0.236])
def test_one_injector_is_off_by_the_amount_and_the_code_says_which_and_which_way(cylinder, amount):
    y = source(BEGIN + 6.0, cylinder=cylinder, amount=amount)
    assert [y[f"offset_{i}"] for i in CYLINDERS] == [amount if i == cylinder else 0.0 for i in CYLINDERS]
    assert y["code"] == (cylinder if amount > 0.0 else -cylinder)


@pytest.mark.parametrize("cylinder", CYLINDERS)
def test_the_opposite_one_is_that_which_fires_a_turn_later_and_the_code_stays(cylinder):
    y = source(BEGIN, cylinder=cylinder, amount=0.1, opposite=1.0)
    wrong = {cylinder, fires_a_turn_later(cylinder)}
    assert {i for i in CYLINDERS if y[f"offset_{i}"] == 0.1} == wrong and len(wrong) == 2
    assert {i for i in CYLINDERS if y[f"offset_{i}"] == 0.0} == set(CYLINDERS) - wrong
    assert y["code"] == cylinder


@given(st.floats(-1e4, 1e6), st.sampled_from(CYLINDERS), st.floats(-1.0, 1.0))
def test_it_begins_at_its_angle_and_not_before(angle, cylinder, amount):
    y = source(angle, cylinder=cylinder, amount=amount)
    begun = angle >= BEGIN
    assert y[f"offset_{cylinder}"] == (amount if begun else 0.0)
    assert y["code"] == (np.sign(amount) * cylinder if begun else 0.0)


def test_without_an_amount_nothing_is_wrong_whatever_is_named():
    assert set(source(BEGIN, cylinder=4.0, amount=0.0, opposite=1.0).values()) == {0.0}


@pytest.mark.parametrize("fmi", [2, 3])
def test_the_fmu_is_its_python_source_bit_for_bit_and_its_code_is_a_whole_number(fmi):
    generator = np.random.default_rng(2)
    for cylinder in CYLINDERS:
        given = {"cylinder": float(cylinder), "amount": generator.uniform(-1, 1), "opposite": float(cylinder % 2)}
        fmu = Filter(MODEL, 1e-3, fmi, begin=np.radians(BEGIN), **given)
        for angle in (0.0, BEGIN - 1e-6, BEGIN + 1e-6, 3.0 * BEGIN):
            row = fmu(angle=angle)
            assert {name: row[name] for name in OUTPUTS} == source(angle, **given)
        (code,) = (signal for signal in fmu.component.outputs if signal.name == "code")
        assert code.kind == "integer"
        fmu.component.close()


@pytest.mark.parametrize("fmi", [2, 3])
def test_it_is_built_by_its_name_and_fmpys_validator_has_no_message(fmi, tmp_path: Path):
    path = build_model(MODEL.name, Export(tmp_path / "fault.fmu", fmi))
    assert validate_fmu(str(path)) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cylinder": 5.0}, "cylinder wants 1 to 4, got 5"),
        ({"cylinder": 2.5}, "cylinder wants a whole number, got 2.5"),
        ({"opposite": 2.0}, "opposite wants 0 to 1, got 2"),
        ({"amount": -1.5}, "amount wants -1 to inf 1, got -1.5"),
    ],
)
def test_what_is_no_cylinder_and_fuel_below_none_is_refused(given, said):
    with pytest.raises(ConfigurationError, match=re.escape(said)):
        Filter(MODEL, 1e-3, **given)
