"""An FMU that declares every capability and fails in one way, chosen when it is built."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

from fmus.toolchain import compile_shared, library_suffix, native_platform

SOURCE = Path(__file__).with_name("deceiver.c")
_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="deceiver" guid="{{deceiver}}" generationTool="by hand" version="{fault}">
<CoSimulation modelIdentifier="deceiver" canHandleVariableCommunicationStepSize="{can}" canGetAndSetFMUstate="{can}"
 canSerializeFMUstate="{can}" providesDirectionalDerivative="{can}"/>
<DefaultExperiment startTime="0" stopTime="10" stepSize="0.1"/>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input" variability="continuous"><Real start="0.5"/></ScalarVariable>
<ScalarVariable name="x" valueReference="1" causality="output" variability="continuous" initial="exact"><Real start="1"/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="2" causality="local" variability="continuous"><Real derivative="2"/></ScalarVariable>
<ScalarVariable name="y" valueReference="3" causality="output" variability="continuous"><Real/></ScalarVariable>
</ModelVariables>
<ModelStructure>
<Outputs><Unknown index="2"/><Unknown index="4"/></Outputs>
<Derivatives><Unknown index="3"/></Derivatives>
<InitialUnknowns><Unknown index="3"/><Unknown index="4"/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>
"""  # noqa: E501 - one variable a line


def faults() -> list[str]:
    """The ways it can fail, by their names in C; the first is none."""
    found = re.search(r"enum \{ (NONE.*?) \}", SOURCE.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    return found[1].replace("\n", " ").replace(" ", "").split(",")


def deceiver(folder: Path, fault: str, declared: bool = True) -> Path:
    """The FMU in a new file of the folder; with `declared` false it declares no capability."""
    path = folder / f"{fault.lower()}.fmu"
    library = compile_shared(f"#define FAULT {fault}\n{SOURCE.read_text(encoding='utf-8')}")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _XML.format(fault=fault, can=str(declared).lower()))
        archive.write(library, f"binaries/{native_platform()}/deceiver{library_suffix()}")
    return path
