"""Broken and hostile SSPs are refused with what is wrong and where, all of it at once, before anything runs."""

from __future__ import annotations

import re
import stat
import sys
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from ssp_files import NAMESPACES, binding, component, connection, connector, description, mapping, package, system, unit
from ssp_files import values as values_of
from third_party import reference_fmu

from fmus.component import ConfigurationError, Signal
from fmus.export import cached_fmu
from fmus.model import Model
from harness.cli import main
from harness.ssp.importing import Clock, import_system

SSD = "a.ssp/SystemStructure.ssd"
STEP = Clock(step="0.1 s")
ENDS = connector("u", "input") + connector("y", "output")


@cache
def through() -> Path:
    """An FMU whose y is its u, with a parameter p that may be 0 to 2."""
    return cached_fmu(
        Model(
            name="through",
            description="y = u",
            equations=lambda t, x, m, u, p: ({}, {"y": u.u + 0.0 * p.p}),
            inputs=(Signal("u", "N.m"),),
            outputs=(Signal("y", "N.m"),),
            parameters=(Signal("p", "1", 1.0, minimum=0.0, maximum=2.0),),
        )
    )


def refused(tmp_path: Path, ssd: str, files: Mapping[str, Any] | None = None) -> list[str]:
    """What is told of an SSP that is refused, problem by problem; it holds `through` as resources/t.fmu."""
    path = package(tmp_path / "a.ssp", ssd, {"resources/t.fmu": through(), **(files or {})})
    with pytest.raises(ConfigurationError) as told:
        import_system(path, clock=STEP)
    return [str(problem) for problem in told.value.problems]


def of_top(tmp_path: Path, *inside: str, files: Mapping[str, Any] | None = None, **more: str) -> list[str]:
    """The same of a system with these elements, connections, ..."""
    return refused(tmp_path, description(system(*inside, **more)), files)


def without_line(problem: str) -> str:
    return re.sub(r"(ssd|ssv|ssm|ssb):\d+", r"\1", problem)


PAIR = component("a", "resources/t.fmu", ENDS) + component("b", "resources/t.fmu", ENDS)
KINDS = {
    "an element that is not there": (
        (PAIR, connection("a.y", "c.u")),
        "connection to c.u: no element of top is named 'c'; did you mean 'b'?",
    ),
    "a connector that is not there": (
        (PAIR, connection("a.y", "b.v")),
        "connection to b.v: no connector of b is named 'v'; did you mean 'y'?",
    ),
    "a connector of the system that is not there": (
        (PAIR, connection("torque", "b.u"), connector("torqe", "input")),
        "connection to torque: no connector of top is named 'torque'; did you mean 'torqe'?",
    ),
    "an FMU that is not there": (
        (component("a", "resources/other.fmu"),),
        "a: no file in the package is named 'resources/other.fmu'; did you mean 'resources/t.fmu'?",
    ),
    "an FMU elsewhere": (
        (component("a", "http://example.org/t.fmu"),),
        "a: wants the relative path of a file in the package, got 'http://example.org/t.fmu'",
    ),
    "an FMU outside of the package": (
        (component("a", "../../t.fmu"),),
        "a: leads outside of the package: '../../t.fmu'",
    ),
    "something else than an FMU": (
        (component("a", "resources/t.fmu", attributes='type="application/x-other"'),),
        "a wants an FMU, a system description or a package, got the type 'application/x-other'",
    ),
    "a kind of FMU that it does not offer": (
        (component("a", "resources/ball.fmu", attributes='implementation="ScheduledExecution"'),),
        "a is to be run by ScheduledExecution, which is not run here",
    ),
    "a component without an implementation": (
        (component("a", "resources/t.fmu").replace('source="resources/t.fmu"', ""),),
        "a has no source: there is nothing to run for it",
    ),
    "two elements of one name": (
        (component("a", "resources/t.fmu") * 2,),
        "'a' is the name of two elements of top",
    ),
    "two outputs joined": (
        (PAIR, connection("a.y", "b.y")),
        "no value flows between a.y (output) and b.y (output): one must give what the other takes",
    ),
    "two connections into one input": (
        (PAIR, connection("a.y", "b.u") + connection("b.y", "b.u")),
        "b.u takes one connection, got a.y and b.y",
    ),
    "a connector that may be either": (
        (
            component("a", "resources/t.fmu", connector("u", "inout")) + PAIR.replace('"a"', '"c"'),
            connection("c.y", "a.u"),
        ),
        "a.u is of the kind inout, which does not say which way values flow",
    ),
    "a connector that is another kind in the FMU": (
        (component("a", "resources/t.fmu", connector("y", "input")),),
        "a.y is an input, its FMU's variable an output",
    ),
    "a connector that is of another type in the FMU": (
        (component("a", "resources/t.fmu", connector("u", "input", "<ssc:Boolean/>")),),
        "a.u is of the type Boolean, its FMU's variable of the type Real",
    ),
    "a connector that is no variable of the FMU": (
        (
            component("a", "resources/t.fmu", connector("w", "output")) + component("b", "resources/t.fmu", ENDS),
            connection("a.w", "b.u"),
        ),
        "a.w is no variable of its FMU",
    ),
    "a table of real numbers": (
        (
            PAIR,
            connection(
                "a.y",
                "b.u",
                '<ssc:IntegerMappingTransformation><ssc:MapEntry source="1" target="2"/>'
                "</ssc:IntegerMappingTransformation>",
            ),
        ),
        "a.y -> b.u maps values of the type Integer, and gets real numbers",
    ),
    "a value outside of its range": (
        (component("a", "resources/t.fmu", bindings=binding(values_of("p=Real:3"))),),
        "a.p wants 0 to 2 1, got 3",
    ),
    "a value for what cannot be set": (
        (component("a", "resources/t.fmu", bindings=binding(values_of("y=Real:3"))),),
        "a.y cannot be set: its causality is output, its variability continuous, its type Real",
    ),
    "text for a number": (
        (component("a", "resources/t.fmu", bindings=binding(values_of("p=String:3"))),),
        "a.p wants a number, its type is Real",
    ),
    "a number that is none": (
        (component("a", "resources/t.fmu", bindings=binding(values_of("p=Real:NaN"))),),
        "p wants finite numbers, got 'NaN'",
    ),
    "a mapping of two parameters to one": (
        (
            component(
                "a",
                "resources/t.fmu",
                bindings=binding(
                    values_of("k=Real:1", "l=Real:2"),
                    mapping=mapping(p="k").replace("</ssm:P", '<ssm:MappingEntry source="l" target="p"/></ssm:P'),
                ),
            ),
        ),
        "both k and l are mapped to p: a parameter takes one value",
    ),
    "a parameter that an FMU computes": (
        (
            component("a", "resources/t.fmu", connector("y", "calculatedParameter"))
            + component("b", "resources/t.fmu", connector("p", "parameter")),
            connection("a.y", "b.p"),
        ),
        "b.p is set from a.y, which an FMU computes: no start value is known",
    ),
    "a set that is not there": (
        (component("a", "resources/t.fmu", bindings=binding(source="resources/p.ssv")),),
        "ParameterBinding: no file in the package is named 'resources/p.ssv'; did you mean 'resources/t.fmu'?",
    ),
    "a set in another format": (
        (component("a", "resources/t.fmu", bindings=binding(source="x").replace("source", 'type="text/csv" source')),),
        "ParameterBinding wants the type application/x-ssp-parameter-set, got 'text/csv'",
    ),
    "a dictionary that is not there": (
        (PAIR + '<ssd:SignalDictionaryReference name="r" dictionary="bus"/>',),
        "r: no signal dictionary is named 'bus'",
    ),
    "nothing that runs": ((), "top holds nothing that runs"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_refused_with_its_place(kind: str, tmp_path: Path):
    inside, message = KINDS[kind]
    version = "2.0" if "implementation" in kind or "ScheduledExecution" in message else "1.0"
    told = refused(
        tmp_path,
        description(system(*inside), version=version),
        {"resources/ball.fmu": reference_fmu("BouncingBall")},
    )
    assert message in [without_line(one).removeprefix(f"{SSD}: ") for one in told]
    assert all(re.match(rf"{SSD}:\d+: ", one) for one in told)


def test_units_that_do_not_fit_are_named_on_both_sides(tmp_path: Path):
    definitions = f"<ssd:Units>{unit('rad/s', rad=1, s=-1)}</ssd:Units>"
    elements = component("a", "resources/v.fmu", connector("x0", "output", '<ssc:Real unit="rad/s"/>'))
    elements += component("b", "resources/t.fmu", ENDS)
    ssd = description(system(elements, connection("a.x0", "b.u")), extra=definitions)
    (told,) = refused(tmp_path, ssd, {"resources/v.fmu": reference_fmu("VanDerPol")})
    assert without_line(told) == f"{SSD}: a.x0 -> b.u wants N.m, got rad/s"


def test_a_unit_that_its_connections_do_not_agree_on_is_asked_for(tmp_path: Path):
    other = cached_fmu(
        Model(
            name="turns",
            description="y = u",
            equations=lambda t, x, m, u, p: ({}, {"y": u.u}),
            inputs=(Signal("u", "rpm"),),
            outputs=(Signal("y", "rpm"),),
        )
    )
    elements = component("a", "resources/v.fmu", connector("x0", "output"))
    elements += component("b", "resources/t.fmu", ENDS) + component("c", "resources/o.fmu", connector("u", "input"))
    ssd = description(system(elements, connection("a.x0", "b.u") + connection("a.x0", "c.u")))
    told = refused(tmp_path, ssd, {"resources/v.fmu": reference_fmu("VanDerPol"), "resources/o.fmu": other})
    assert any("a.x0 has no unit, and is joined to N.m and rpm: its connector wants a unit" in one for one in told)


def test_several_problems_are_told_at_once_each_with_its_line(tmp_path: Path):
    elements = component("a", "resources/x.fmu") + component("b", "resources/y.fmu", attributes='type="other"')
    told = of_top(tmp_path, elements + component("c", "resources/t.fmu") * 2)
    assert [without_line(one).removeprefix(f"{SSD}: ").split(" ")[0] for one in told] == ["a:", "b", "'c'"]
    lines = [int(re.findall(r"ssd:(\d+)", one)[0]) for one in told]
    assert lines == sorted(set(lines))


def test_connections_that_go_round_through_systems_alone_are_refused(tmp_path: Path):
    def loop(name: str) -> str:
        ends = connector("in", "input") + connector("out", "output")
        return system(connections=connection("in", "out"), connectors=ends, name=name)

    outer = system(
        component("x", "resources/t.fmu", ENDS), connection("in", "x.u"), connector("in", "input"), name="outer"
    )
    joined = connection("one.out", "two.in") + connection("two.out", "one.in") + connection("two.out", "outer.in")
    (told,) = of_top(tmp_path, outer + loop("one") + loop("two"), joined)
    circle = "two.in -> two.out, one.out -> two.in, one.in -> one.out, two.out -> one.in"
    assert without_line(told) == f"{SSD}: connections go round in a circle: {circle}"


@pytest.mark.parametrize("how", ["package", "definition", "same document"])
def test_a_system_that_stands_inside_of_itself_is_refused(how: str, tmp_path: Path):
    sources = {
        "package": ("resources/b.ssp", "application/x-ssp-package"),
        "definition": ("SystemStructure.ssd", "application/x-ssp-definition"),
        "same document": ("#box", "application/x-ssp-definition"),
    }
    source, media = sources[how]
    inner = component("again", source, attributes=f'type="{media}"')
    box = system(inner, name="box").replace("<ssd:System ", '<ssd:System id="box" ', 1)
    files = {}
    if how == "package":  # a package cannot hold itself: one in it refers to its own description
        own = component("again", "SystemStructure.ssd", attributes='type="application/x-ssp-definition"')
        files["resources/b.ssp"] = package(tmp_path / "b.ssp", description(system(own)))
    told = refused(tmp_path, description(system(box)), files)
    assert any("again stands inside of itself" in one for one in told)


def test_a_small_file_that_stands_for_an_endless_system_is_refused(tmp_path: Path):
    """Ten levels of ten references to the level below."""
    levels = "".join(
        system(
            "".join(
                component(f"c{i}", f"#level{level + 1}", attributes='type="application/x-ssp-definition"')
                for i in range(10)
            ) if level < 9 else component("end", "resources/t.fmu"),
            name=f"level{level}",
        ).replace("<ssd:System ", f'<ssd:System id="level{level}" ', 1)
        for level in range(10)
    )  # fmt: skip
    (told,) = of_top(tmp_path, levels)
    assert told == f"{SSD}: wants at most 10000 elements, with those of references"


def test_what_breaks_the_schema_is_told_line_by_line(tmp_path: Path):
    elements = component("a", "resources/t.fmu", connector("u", "sideways")) + "<ssd:Other/>"
    told = of_top(tmp_path, elements)
    assert len(told) >= 2 and all(one.startswith(f"{SSD}:") for one in told)
    assert any("'sideways' is not an element of the set" in one for one in told)


def test_sets_inside_and_beside_are_held_against_their_schema(tmp_path: Path):
    wrong = values_of("p=Real:1").replace("ssv:Real", "ssv:Rael")
    inline = of_top(tmp_path, component("a", "resources/t.fmu", bindings=binding(wrong)))
    assert any("Rael" in one and one.startswith(SSD) for one in inline)
    beside = component("a", "resources/t.fmu", bindings=binding(source="resources/p.ssv"))
    told = of_top(tmp_path, beside, files={"resources/p.ssv": wrong})
    assert any("Rael" in one and one.startswith("a.ssp/resources/p.ssv:") for one in told)


def test_another_version_is_refused(tmp_path: Path):
    told = refused(tmp_path, description(system(PAIR), version="3.0"))
    assert any("3.0" in one for one in told)


ENTITIES = """<?xml version="1.0"?>
<!DOCTYPE x [<!ENTITY a "0123456789"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>
"""


def test_entities_and_document_types_are_refused_wherever_they_stand(tmp_path: Path):
    ssd = description(system(PAIR)).partition("?>\n")[2]
    (told,) = refused(tmp_path, ENTITIES + ssd)
    assert told == f"{SSD} declares a document type or entities, which is refused"
    beside = component("a", "resources/t.fmu", bindings=binding(source="resources/p.ssv"))
    (told,) = of_top(tmp_path, beside, files={"resources/p.ssv": ENTITIES + values_of("p=Real:1")})
    assert "a.ssp/resources/p.ssv declares a document type or entities, which is refused" in told


def test_what_is_no_xml_or_another_document_is_refused(tmp_path: Path):
    assert "is not XML" in refused(tmp_path, "<ssd:System")[0]
    (told,) = refused(tmp_path, f"<other {NAMESPACES}/>")
    assert told == f"{SSD}:1: wants the element SystemStructureDescription of SSP, got other"


def test_an_archive_without_a_description_says_what_it_has(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "a.ssp", "w") as archive:
        archive.writestr("Other.ssd", description(system(PAIR)))
    with pytest.raises(ConfigurationError, match=r"wants a SystemStructure.ssd at its top, found Other.ssd"):
        import_system(tmp_path / "a.ssp")
    with pytest.raises(ConfigurationError, match=r"no system description is named 'Nobody\.ssd'"):
        import_system(tmp_path / "a.ssp", "Nobody")


def test_archives_that_lead_outside_or_swell_are_refused(tmp_path: Path):
    outside = tmp_path / "outside.ssp"
    with zipfile.ZipFile(outside, "w") as archive:
        archive.writestr("../evil.ssd", "x")
    with pytest.raises(ConfigurationError, match="leads outside of it"):
        import_system(outside)
    link = zipfile.ZipInfo("SystemStructure.ssd")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "link.ssp", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(ConfigurationError, match="which is a link"):
        import_system(tmp_path / "link.ssp")
    with zipfile.ZipFile(tmp_path / "bomb.ssp", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("SystemStructure.ssd", b" " * (200 << 20))
    with pytest.raises(ConfigurationError, match="unpacks to more bytes than are taken"):
        import_system(tmp_path / "bomb.ssp")
    (tmp_path / "text.ssp").write_text("no archive")
    with pytest.raises(ConfigurationError, match="is no intact zip archive"):
        import_system(tmp_path / "text.ssp")


def test_a_time_that_nobody_says_is_asked_for(tmp_path: Path):
    path = package(tmp_path / "a.ssp", description(system(PAIR), extra=""), {"resources/t.fmu": through()})
    with pytest.raises(ConfigurationError) as told:
        import_system(path)
    assert str(told.value) == "neither the SSP nor its FMUs say a step: give one, like --step '10 ms'"
    with pytest.raises(ConfigurationError, match="--step wants a time: "):
        import_system(path, clock=Clock(step="10 mm", stop="1 s"))


def test_the_command_ends_with_2_and_writes_nothing(tmp_path: Path, monkeypatch: Any, capsys: Any):
    path = package(
        tmp_path / "a.ssp", description(system(PAIR, connection("a.y", "c.u"))), {"resources/t.fmu": through()}
    )
    for arguments in (["ssp", "import", path, "--out", tmp_path / "in"], ["run", path], ["run", tmp_path / "none.ssp"]):
        monkeypatch.setattr(sys, "argv", ["crankbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code == 2
        assert re.search(r"no element of top is named 'c'|no SSP file", capsys.readouterr().err)
    assert not (tmp_path / "in").exists()
