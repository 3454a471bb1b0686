"""The tiers of validation: what a model description breaks is refused, tolerated and listed, or not looked for."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from third_party import reference_fmu

from fmus.component import ConfigurationError
from fmus.fmu import describe, load_fmu
from harness.campaign import read_campaign
from harness.cases import execute
from reports.folder import read_run
from reports.provenance import facts, tolerated

RULE = "colour"  # an attribute that the standard knows nothing of
CAMPAIGN = """\
campaign: tiers
clock: {{time: {{step: 100 ms, stop: 0.3 s}}}}
{validation}
parts:
  plant: {{use: {fmu}}}
"""


@pytest.fixture
def odd_fmu(tmp_path: Path) -> Path:
    """An FMU that breaks one rule of the standard and runs all the same."""
    odd = tmp_path / "odd.fmu"
    with zipfile.ZipFile(reference_fmu("Dahlquist")) as plain, zipfile.ZipFile(odd, "w") as target:
        for name in (entry for entry in plain.namelist() if not entry.endswith("/")):
            content = plain.read(name)
            if name == "modelDescription.xml":
                content = content.replace(b'modelName="Dahlquist"', f'modelName="Dahlquist" {RULE}="red"'.encode())
            target.writestr(name, content)
    return odd


def ended(tmp_path: Path, fmu: Path, validation: str) -> Path:
    file = tmp_path / "tiers.yaml"
    file.write_text(CAMPAIGN.format(fmu=fmu, validation=validation))
    execute(read_campaign(file), tmp_path / "run", 1, lambda ended: None)
    return tmp_path / "run"


def test_a_broken_rule_is_refused_tolerated_or_not_looked_for(odd_fmu: Path):
    with pytest.raises(ConfigurationError, match=RULE):
        describe(odd_fmu, "strict")
    with pytest.raises(ConfigurationError, match=RULE):
        load_fmu(odd_fmu, validation="strict")
    assert any(RULE in caution for caution in describe(odd_fmu).cautions)
    assert describe(odd_fmu).cautions == describe(odd_fmu, "warn").cautions
    assert not any(RULE in caution for caution in describe(odd_fmu, "off").cautions)


def test_what_is_tolerated_stands_in_the_case_and_in_the_reports_provenance(tmp_path: Path, odd_fmu: Path):
    folder = ended(tmp_path, odd_fmu, "")
    (case,) = (json.loads(file.read_text()) for file in folder.glob("cases/*/case.json"))
    assert case["outcome"] == "ok"
    assert any(RULE in warning["text"] and warning["part"] == "plant" for warning in case["warnings"])
    rows = [row for row in tolerated(read_run(folder)) if RULE in row.message]
    assert [row.cases for row in rows] == [1]
    assert ("validation of FMUs", "warn") in facts(read_run(folder))
    assert rows[0].message.startswith("plant, tolerated: ")


def test_a_strict_campaign_refuses_before_anything_is_written(tmp_path: Path, odd_fmu: Path):
    with pytest.raises(ConfigurationError, match=RULE) as refused:
        ended(tmp_path, odd_fmu, "validation: strict")
    assert refused.value.problems[0].line == 5
    assert not (tmp_path / "run").exists()


def test_a_campaign_without_validation_lists_no_broken_rule(tmp_path: Path, odd_fmu: Path):
    folder = ended(tmp_path, odd_fmu, "validation: off")
    (case,) = (json.loads(file.read_text()) for file in folder.glob("cases/*/case.json"))
    assert not any(RULE in warning["text"] for warning in case["warnings"])


def test_an_unknown_tier_is_refused_with_those_there_are(tmp_path: Path, odd_fmu: Path):
    with pytest.raises(ConfigurationError, match="strict"):
        ended(tmp_path, odd_fmu, "validation: lax")
