"""A campaign file becomes the cases it asks for, or a list of all that is wrong with it, each at its place."""

import json
import re
import sys
import textwrap
from pathlib import Path

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fmus.component import ConfigurationError
from harness.campaign import built_in_campaigns, find_campaign, read_campaign
from harness.cli import schema_text
from harness.fingerprint import forget_sources
from harness.metrics import KINDS
from harness.places import read_yaml, read_yaml_file

GOOD = """\
campaign: rig
description: a source, measured
clock: {time: {step: 1 ms, stop: 1 s}}
seed: 7
parts:
  torque: {use: source, unit: N.m, step: {at: 0.5 s, from: 0 N.m, to: -10 N.m}}
  plant:
    use: fmus.plants.driveline
    with: {k: 1500 N.m/rad}
    wires: {T_eng: torque}
  encoder: {use: sensor, of: plant.y, noise: {std: 0.5 rpm}}
metrics:
  rmse: {rmse: [plant.y, encoder.value], unit: rpm}
  located: {detection: [plant.location, plant.location]}
accept:
  - rmse < 1 rpm
"""


def campaign(tmp_path, text, *overrides):
    file = tmp_path / "rig.yaml"
    file.write_text(text if text.startswith("\t") else textwrap.dedent(text))
    return read_campaign(file, overrides)


def problems(tmp_path, text, *overrides):
    """What is wrong, as `line:column: message` without the file."""
    with pytest.raises(ConfigurationError) as error:
        campaign(tmp_path, text, *overrides)
    return [str(problem).replace(f"{tmp_path / 'rig.yaml'}:", "") for problem in error.value.problems]


def changed(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


def values(tmp_path, addition, *overrides):
    return [case.values for case in campaign(tmp_path, GOOD + addition, *overrides).cases]


def test_a_campaign_without_axes_is_one_case_as_declared(tmp_path):
    (case,) = campaign(tmp_path, GOOD).cases
    assert (case.label, case.experiment, dict(case.values)) == ("as declared", "", {})
    assert case.scenario.seed == 7


def test_axes_are_multiplied_with_the_last_one_fastest(tmp_path):
    found = values(tmp_path, 'vary: {plant.k: "[4000, 5000] N.m/rad", seed: 1..3}\n')
    assert [tuple(one.values()) for one in found] == [
        (f"{k} N.m/rad", str(seed)) for k in (4000, 5000) for seed in (1, 2, 3)
    ]


def test_a_joint_axis_moves_its_paths_together(tmp_path):
    pairs = "[[1500 N.m/rad, 5000 N.m/rad], [1650 N.m/rad, 5500 N.m/rad]]"
    file = GOOD + f'vary: {{"plant.k, plant.k_1": {pairs}}}\n'
    settings = [case.scenario.parts["plant"].settings for case in campaign(tmp_path, file).cases]
    assert settings == [{"k": "1500 N.m/rad", "k_1": "5000 N.m/rad"}, {"k": "1650 N.m/rad", "k_1": "5500 N.m/rad"}]


def test_each_experiment_has_its_own_overrides_and_axes(tmp_path):
    addition = """\
experiments:
  small: {set: {torque.step.to: -1 N.m}}
  noisy: {set: {encoder.noise.std: 5 rpm, plant.wires.T_eng: torque}, vary: {seed: [3, 4]}}
"""
    cases = campaign(tmp_path, GOOD + addition).cases
    assert [case.label for case in cases] == ["small", "noisy: seed = 3", "noisy: seed = 4"]
    assert [str(case.scenario.parts["torque"].step.to) for case in cases] == ["-1.0 N.m", "-10.0 N.m", "-10.0 N.m"]
    assert [str(case.scenario.parts["encoder"].noise.std) for case in cases] == ["0.5 rpm", "5.0 rpm", "5.0 rpm"]


def test_an_experiment_may_add_parts_and_replace_them(tmp_path):
    addition = """\
experiments:
  plain: {}
  shaken:
    parts:
      shaker: {use: source, unit: N.m, constant: 3 N.m}
      encoder: {use: sensor, of: shaker, noise: {std: 1 N.m}}
    set: {plant.wires.T_eng: shaker, shaker.constant: 4 N.m}
"""
    plain, shaken = (case.scenario.parts for case in campaign(tmp_path, GOOD + addition).cases)
    assert list(plain) == ["torque", "plant", "encoder"]
    assert list(shaken) == ["torque", "plant", "encoder", "shaker"]
    assert (shaken["encoder"].of, str(shaken["shaker"].constant)) == ("shaker", "4.0 N.m")


def test_what_is_wrong_with_a_part_of_an_experiment_is_told_once_and_there(tmp_path):
    addition = """\
experiments:
  shaken:
    parts:
      shaker: {use: source, unit: N.m, constnt: 3 N.m}
      "a b": {use: sensor, of: plant.y}
    set: {shaker.unit: rad}
"""
    assert problems(tmp_path, GOOD + addition) == [
        "20:40: unknown key 'constnt' in experiments.shaken.parts.shaker; did you mean 'constant'?",
        "21:7: parts: a name wants letters, digits and _, got 'a b'",
    ]


def test_an_override_stands_above_the_file_and_its_experiments(tmp_path):
    addition = "experiments: {small: {set: {torque.step.to: -1 N.m}}}\n"
    (case,) = campaign(tmp_path, GOOD + addition, "torque.step.to=-3 N.m", "seed=9", "clock.time.stop=2 s").cases
    assert (str(case.scenario.parts["torque"].step.to), case.scenario.seed) == ("-3.0 N.m", 9)
    assert str(case.scenario.clock.time.stop) == "2.0 s"


def test_an_override_may_replace_an_axis_or_a_limit(tmp_path):
    addition = "experiments: {small: {vary: {seed: 1..20}}}\n"
    found = campaign(tmp_path, GOOD + addition, "experiments.small.vary.seed=1..2", "limits.case=3 s")
    assert ([dict(case.values) for case in found.cases], found.limits.seconds) == ([{"seed": "1"}, {"seed": "2"}], 3.0)


def test_an_override_of_something_varied_says_how_to_vary_it_otherwise(tmp_path):
    (problem,) = problems(tmp_path, GOOD + "vary: {seed: 1..20}\n", "seed=3")
    assert problem == "--set seed=3: the campaign varies seed; write vary.seed='[...]' to vary it otherwise"


def test_faults_in_a_list_are_reached_by_their_number(tmp_path):
    text = changed("noise: {std: 0.5 rpm}", "faults: [{bias: 5 rpm, from: 0.2 s}]")
    (first, second) = campaign(tmp_path, text + "vary: {encoder.faults.0.bias: [1 rpm, 2 rpm]}\n").cases
    assert str(second.scenario.parts["encoder"].faults[0].bias) == "2.0 rpm"
    assert str(first.scenario.parts["encoder"].faults[0].bias) == "1.0 rpm"


def test_every_problem_is_told_at_once_in_the_order_of_the_file(tmp_path):
    text = """\
    campaign: rig
    clock: {time: {stepp: 1 ms, stop: 5 furlong}}
    sed: 1
    parts:
      torque: {use: source, unit: N.m, stp: {at: 2 s}}
      plant: {use: fmus.plants.driveline, wirs: {T_eng: torque}}
      encoder: {use: sensr, of: plant.y, noise: {std: loud}}
    metrics:
      rmse: {rmsee: [plant.y, encoder.value]}
      alone: {rmse: [plant.y]}
      double: {mean: plant.y, bias: [plant.y, encoder.value]}
      late: {mean: plant.y, after: 3 rpm}
    accept:
      - late < 1 rpm ; late
      - {figur_6: late < 1}
      - 3
    limits: {case: 3 m}
    """
    assert problems(tmp_path, text) == [
        "2:9: clock.time wants the key 'step'",
        "2:16: unknown key 'stepp' in clock.time; did you mean 'step'?",
        "2:35: clock.time.stop: unknown unit 'furlong'",
        "3:1: unknown key 'sed'; did you mean 'seed'?",
        "5:36: unknown key 'stp' in parts.torque; did you mean 'step'?",
        "6:39: unknown key 'wirs' in parts.plant; did you mean 'wires'?",
        "7:18: parts.encoder.use wants 'sensor', got 'sensr'",
        "7:51: parts.encoder.noise.std: 'loud' wants a number with a unit, like '1 ms'",
        "9:10: unknown key 'rmsee' in metrics.rmse; did you mean 'rmse'?",
        "10:11: metrics.alone.rmse.pairs[0] wants at least 2 items",
        f"11:11: metrics.double wants one of {', '.join(KINDS)}, got bias and mean",
        "12:9: metrics.late: after wants a time or a crank angle, like 0.5 s or 720 deg, got 3.0 rpm",
        "15:6: no experiment is named 'figur_6'",
        "16:5: accept[2] wants 'metric < bound' or {experiment: 'metric < bound'}, got 3",
        "17:16: limits.case wants s, got 3 m",
    ]


@pytest.mark.parametrize(
    ("addition", "said"),
    [
        ("vary: {plnt.k: [1]}", "17:8: plnt.k: no part is named 'plnt'; did you mean 'plant'?"),
        ("vary: {seed: 3}", '17:14: vary seed: wants a list, "[1, 2] unit" or 1..20, got 3'),
        ("vary: {seed: []}", "wants a list"),
        ('vary: {"plant.k, seed": [[1, 2], 3]}', "17:34: vary plant.k, seed: wants 2 values together, got 3"),
        ("vary: {seed: 1..2000000}", "wants a list"),
        ("vary: {seed: [1, x]}", "17:18: seed wants a whole number, got 'x'"),
        ("vary: {encoder.nois.std: [1 rpm]}", "17:8: unknown key 'nois' in parts.encoder; did you mean 'noise'?"),
        ("vary: {encoder.noise.std: [1 rpm, 2 rp]}", "17:35: parts.encoder.noise.std: unknown unit 'rp'"),
        ("vary: {encoder.use.x: [1]}", "17:8: encoder.use.x: 'parts.encoder.use.x' leads nowhere: there is 'sensor'"),
        ("vary: {seed: 1..3, 'seed, plant.k': [[1, 2]]}", "seed is varied twice"),
        ("experiments: {a: {st: {}}}", "17:19: unknown key 'st' in experiments.a; did you mean 'set'?"),
        ("experiments: {a: {set: {seed: -1}}}", "17:31: seed wants at least 0, got -1"),
        ("experiments: {a: {}}\nvary: {seed: 1..2}", "18:1: vary wants to stand inside the experiments"),
        ("report: {observers: {encodr: {}}}", "no part is named 'encodr'; did you mean 'encoder'?"),
        ("report: {observers: {encoder: {metrics: [rms]}}}", "no metric is named 'rms'; did you mean 'rmse'?"),
        ("report: {figures: [{title: a, traces: [[x]], color: red}]}", "unknown key 'color' in report.figures[0]"),
    ],
)
def test_what_is_wrong_with_axes_experiments_and_report_is_told(tmp_path, addition, said):
    found = problems(tmp_path, GOOD + addition + "\n")
    assert len(found) == 1
    assert said in found[0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: [1, 2] rad\n", "1:11: not YAML: while parsing a block mapping, expected <block end>, but found"),
        ("a: [1, 2] rad\n", 'a list with one unit is written in quotes: "[1, 2] rad"'),
        ("a: 1\nb: {c: 1, c: 2}\na: 3\n", "2:11: the key 'c' is given twice, first in line 2"),
        ("a: 1\nb: {c: 1, c: 2}\na: 3\n", "3:1: the key 'a' is given twice, first in line 1"),
        ("a: &x {b: *x}\n", "an alias wants something finite"),
        ("a: *x\n", "1:4: not YAML: found undefined alias 'x'"),
        ("a: !!int seven\n", "1:4: wants a number, got 'seven'"),
        ("a: !python/object x\n", "the tag '!python/object' means nothing here"),
        ("\ta: 1\n", "1:1: not YAML"),
        ("a: 1\n---\na: 2\n", "found another document"),
        ("", "a campaign wants a mapping of keys to values, got none"),
        ("- 1\n", "a campaign wants a mapping of keys to values, got none"),
    ],
)
def test_what_is_not_yaml_is_told_at_its_place(tmp_path, text, said):
    assert said in "\n".join(problems(tmp_path, text))


def test_aliases_that_multiply_without_end_are_refused():
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 9)]
    with pytest.raises(ConfigurationError, match="wants at most 100000 values"):
        read_yaml("\n".join(lines))


def test_a_file_that_cannot_be_read_is_told(tmp_path):
    with pytest.raises(ConfigurationError, match="No such file"):
        read_yaml_file(tmp_path / "no.yaml")
    (tmp_path / "latin.yaml").write_bytes("campaign: zündung".encode("latin-1"))
    with pytest.raises(ConfigurationError, match="wants UTF-8"):
        read_yaml_file(tmp_path / "latin.yaml")


# Characters that both JSON and YAML take as they are.
TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=8)


@given(
    st.recursive(
        st.one_of(st.integers(), st.booleans(), st.none(), st.floats(allow_nan=False, allow_infinity=False), TEXT),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
        max_leaves=12,
    )
)
def test_json_is_yaml_and_reads_as_what_it_is(value):
    text = json.dumps(value)
    assert read_yaml(text)[0] == json.loads(text)


@given(st.text(max_size=40))
def test_any_text_is_read_or_refused_but_never_breaks_the_reader(text):
    try:
        read_yaml(text)
    except ConfigurationError as error:
        assert error.problems


def keys(tmp_path, text, *overrides):
    return [case.key for case in campaign(tmp_path, text, *overrides).cases]


def test_the_key_is_that_of_the_scenario_and_not_of_its_metrics(tmp_path):
    assert keys(tmp_path, GOOD) == keys(tmp_path, changed("unit: rpm", "unit: rad/s, after: 0.1 s"))
    assert keys(tmp_path, GOOD) == keys(tmp_path, changed("rmse < 1 rpm", "rmse < 2 rpm"))
    assert keys(tmp_path, GOOD) == keys(tmp_path, "# a comment\n" + GOOD)
    others = [
        changed("seed: 7", "seed: 8"),
        changed("stop: 1 s", "stop: 2 s"),
        changed("k: 1500", "k: 1501"),
        changed("metrics:", "record: [plant]\nmetrics:"),
    ]
    assert len({key for text in [GOOD, *others] for key in keys(tmp_path, text)}) == 5
    assert all(re.fullmatch(r"[0-9a-f]{16}", key) for key in keys(tmp_path, GOOD))


def test_the_key_follows_the_content_of_an_fmu(tmp_path):
    text = changed("use: fmus.plants.driveline", "use: vendor.fmu")
    (tmp_path / "vendor.fmu").write_bytes(b"one")
    before = keys(tmp_path, text)
    (tmp_path / "vendor.fmu").write_bytes(b"another")
    assert keys(tmp_path, text) != before


def test_the_key_follows_a_module_beside_the_file_and_what_it_imports(tmp_path, monkeypatch):
    text = changed("use: fmus.plants.driveline", "use: my_rig.plant")
    monkeypatch.setattr("sys.path", list(sys.path))
    (tmp_path / "my_rig").mkdir()
    files = [tmp_path / "my_rig" / name for name in ("__init__.py", "plant.py", "gears.py", "unused.py")]
    for file in files:
        file.write_text("from my_rig import gears\n" if file.name == "plant.py" else "")
    found = []
    for file in (None, *files):
        if file is not None:
            file.write_text(f"{file.read_text()}# changed\n")
        forget_sources()
        found += keys(tmp_path, text)
    as_it_was, package, plant, gears, unused = found
    assert len({as_it_was, package, plant, gears}) == 4
    assert unused == gears


def test_the_key_follows_the_plant_that_an_observer_is_made_from(tmp_path):
    made = "use: observers.open_loop\n    with: {plant: %s}"
    one, other = (
        changed("use: fmus.plants.driveline\n    with: {k: 1500 N.m/rad}", made % plant)
        for plant in ("fmus.plants.driveline", "fmus.plants")
    )
    assert keys(tmp_path, one) != keys(tmp_path, other)


def test_an_unknown_built_in_name_is_told_with_those_there_are(tmp_path):
    with pytest.raises(ConfigurationError, match="no built-in campaign is named 'drivelin'"):
        find_campaign("drivelin")
    with pytest.raises(ConfigurationError, match="no campaign file"):
        find_campaign(str(tmp_path / "no.yaml"))


@pytest.mark.parametrize("name", list(built_in_campaigns()))
def test_every_built_in_campaign_is_in_order_and_says_what_it_is(name):
    found = read_campaign(built_in_campaigns()[name])
    assert found.name == name
    assert found.cases
    assert found.written["description"]


DOCS = Path(__file__).parent.parent / "docs"


def examples():
    """The campaign files in the documentation."""
    pages = "".join(page.read_text() for page in sorted(DOCS.glob("*.md")))
    return [block for block in re.findall(r"```yaml\n(.*?)```", pages, re.DOTALL) if block.startswith("campaign:")]


@pytest.mark.parametrize("text", examples())
def test_the_examples_of_the_documentation_are_campaigns_and_fit_the_schema(tmp_path, text):
    assert campaign(tmp_path, text).cases
    jsonschema.validate(read_yaml(text)[0], json.loads(schema_text()))


def test_the_published_schema_is_the_schema():
    assert (DOCS / "campaign.schema.json").read_text() == schema_text()


def test_the_schema_refuses_what_reading_refuses(tmp_path):
    bad, _ = read_yaml(changed("noise: {std: 0.5 rpm}", "nois: {std: 0.5 rpm}"))
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(bad, json.loads(schema_text()))
    jsonschema.validate(read_yaml(GOOD)[0], json.loads(schema_text()))
