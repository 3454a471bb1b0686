"""A Model Exchange FMU of FMI 1.0 or 2.0 that misbehaves when asked to; see exchange_fmu.c."""

from __future__ import annotations

import zipfile
from pathlib import Path

from fmus.toolchain import compile_shared, library_suffix, native_platform

_TABLE = """
mode         0 parameter Integer
u            0 input     Real
x            1 output    Real
r            2 output    Real
ticks        3 output    Real
switches     4 output    Real
step_events  5 output    Real
der(x)       6 local     Real
der(r)       7 local     Real
up           0 output    Boolean
label        0 parameter String
"""
_HEAD2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="exchange" guid="{{exchange}}" numberOfEventIndicators="1">
<ModelExchange modelIdentifier="exchange" canGetAndSetFMUstate="true"/><ModelVariables>{variables}</ModelVariables>
<ModelStructure><Outputs>{outputs}</Outputs>
<Derivatives><Unknown index="8"/><Unknown index="9"/></Derivatives></ModelStructure></fmiModelDescription>"""
_HEAD1 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="exchange" modelIdentifier="exchange" guid="{{exchange}}"
 numberOfContinuousStates="2" numberOfEventIndicators="1">
<ModelVariables>{variables}</ModelVariables></fmiModelDescription>"""


def _variable(line: str, fmi: int) -> str:
    name, reference, causality, kind = line.split()
    variability = "continuous" if kind == "Real" else "discrete"
    start = {"mode": ' start="0"', "u": ' start="0"', "label": ' start="plain"'}.get(name, "")
    if causality == "parameter":
        variability = "fixed" if fmi == 2 else "parameter"
    if fmi == 1 and causality != "input":
        causality = "output" if causality == "output" else "internal"
    derivative = {"der(x)": ' derivative="3"', "der(r)": ' derivative="4"'}.get(name, "") if fmi == 2 else ""
    return (
        f'<ScalarVariable name="{name}" valueReference="{reference}" causality="{causality}" '
        f'variability="{variability}"><{kind}{start}{derivative}/></ScalarVariable>'
    )


def exchange_fmu(folder: Path, fmi: int) -> Path:
    """The FMU in a new folder."""
    path = folder / f"exchange{fmi}.fmu"
    source = Path(__file__).with_name("exchange_fmu.c").read_text(encoding="utf-8")
    library = compile_shared(("#define FMI1\n" if fmi == 1 else "") + source)
    lines = _TABLE.strip().splitlines()
    outputs = "".join(f'<Unknown index="{i + 1}"/>' for i, line in enumerate(lines) if " output " in line)
    head = _HEAD1 if fmi == 1 else _HEAD2
    with zipfile.ZipFile(path, "w") as archive:
        variables = "".join(_variable(line, fmi) for line in lines)
        archive.writestr("modelDescription.xml", head.format(variables=variables, outputs=outputs))
        archive.write(library, f"binaries/{native_platform()}/exchange{library_suffix()}")
    return path
