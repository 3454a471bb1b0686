"""An FMI 2.0 FMU that gives back its inputs, notes every call made on it, and misbehaves when asked to."""

from __future__ import annotations

import ctypes
import zipfile
from pathlib import Path

from fmus.toolchain import compile_shared, library_suffix, native_platform

_PARAMETERS = """
mode        0 <Integer start="0"/>
label       0 <String start="a b"/>
idle        9 <Real unit="rpm" start="800" min="500" max="1200"/>
"""
_INPUTS = """
speed       1 <Real unit="rpm" start="60"/>
count       1 <Integer start="7"/>
temperature 2 <Real unit="degC" start="20"/>
flag        2 <Boolean start="true"/>
road        3 <Real unit="leagues/h" start="2"/>
rise        4 <Real unit="degC" relativeQuantity="true" start="5"/>
torque      5 <Real unit="N.m" start="3"/>
wish        6 <Real unit="furlong" start="1"/>
bare        7 <Real start="1"/>
"""
# They have the value references of what they give back. The types are mixed on purpose.
_OUTPUTS = """
speed_out       1 <Real unit="rpm"/>
count_out       1 <Integer/>
temperature_out 2 <Real unit="degC"/>
flag_out        2 <Boolean/>
road_out        3 <Real unit="leagues/h"/>
rise_out        4 <Real declaredType="difference"/>
torque_out      5 <Real unit="N.m"/>
wish_out        6 <Real unit="furlong"/>
bare_out        7 <Real/>
raw_speed       1 <Real/>
raw_temperature 2 <Real/>
raw_idle        9 <Real/>
"""
_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="echo" guid="{{echo}}" generationTool="by hand" version="{marker}">
<CoSimulation modelIdentifier="echo" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions>
<Unit name="rpm"><BaseUnit s="-1" rad="1" factor="0.104719755119659775"/></Unit>
<Unit name="degC"><BaseUnit K="1" offset="273.15"/></Unit>
<Unit name="leagues/h"><BaseUnit m="1" s="-1" factor="1.543333"/></Unit>
<Unit name="furlong"/><Unit name="N.m"/>
</UnitDefinitions>
<TypeDefinitions>
<SimpleType name="difference"><Real unit="degC" relativeQuantity="true"/></SimpleType>
</TypeDefinitions>
<LogCategories><Category name="logStatusError"/><Category name="logEvents"/></LogCategories>
<ModelVariables>{variables}</ModelVariables>
<ModelStructure><Outputs>{outputs}</Outputs></ModelStructure>
</fmiModelDescription>
"""


def _variables(table: str, causality: str) -> list[str]:
    made = []
    for line in table.strip().splitlines():
        name, reference, element = line.split(maxsplit=2)
        variability = "continuous" if element.startswith("<Real") else "discrete"
        attributes = {
            "name": name,
            "valueReference": reference,
            "causality": causality,
            "variability": "fixed" if causality == "parameter" else variability,
        }
        written = " ".join(f'{key}="{value}"' for key, value in attributes.items())
        made.append(f"<ScalarVariable {written}>{element}</ScalarVariable>")
    return made


def _description(marker: int) -> str:
    others = _variables(_PARAMETERS, "parameter") + _variables(_INPUTS, "input")
    outputs = _variables(_OUTPUTS, "output")
    indices = (len(others) + 1 + i for i in range(len(outputs)))
    unknowns = "".join(f'<Unknown index="{index}"/>' for index in indices)
    return _XML.format(marker=marker, variables="".join(others + outputs), outputs=unknowns)


def echo_fmu(folder: Path, marker: int) -> Path:
    """The FMU in a new folder; one with another `marker` is another FMU, whose library notes calls of its own."""
    path = folder / f"echo{marker}.fmu"
    library = compile_shared(Path(__file__).with_name("echo_fmu.c").read_text(encoding="utf-8"))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _description(marker))
        archive.write(library, f"binaries/{native_platform()}/echo{library_suffix()}")
    return path


def calls_on(library: Path | None) -> bytes:
    """The calls a loaded library noted, a letter each: Instantiate, eXperiment, [ ], s, D, g, Terminate, Free."""
    return (ctypes.c_char * 4096).in_dll(ctypes.CDLL(str(library)), "calls").value
