"""FMUs that misbehave, each in the way that its guid names; misbehave.c knows the ways."""

from __future__ import annotations

import zipfile
from pathlib import Path

from fmus.toolchain import compile_shared, library_suffix, native_platform

_XML = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="misbehave" guid="{way}" generationTool="by hand">
<CoSimulation modelIdentifier="misbehave" canHandleVariableCommunicationStepSize="true"/>
<UnitDefinitions>
<Unit name="m/s"><BaseUnit m="1" s="-1"/></Unit><Unit name="m"><BaseUnit m="1"/></Unit>
</UnitDefinitions>
<ModelVariables>
<ScalarVariable name="u" valueReference="0" causality="input"><Real unit="m/s" start="0"/></ScalarVariable>
<ScalarVariable name="x" valueReference="1" causality="output"><Real unit="m"/></ScalarVariable>
</ModelVariables>
<ModelStructure>
<Outputs><Unknown index="2" dependencies=""/></Outputs>
<InitialUnknowns><Unknown index="2" dependencies=""/></InitialUnknowns>
</ModelStructure>
</fmiModelDescription>
"""


def misbehaving_fmu(folder: Path, way: str) -> Path:
    """The FMU that misbehaves in this way, in `folder`; `well` is none that misbehave.c knows."""
    path = folder / f"{way.replace(' ', '_').replace(',', '')}.fmu"
    library = compile_shared(Path(__file__).with_name("misbehave.c").read_text(encoding="utf-8"))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", _XML.format(way=way))
        archive.write(library, f"binaries/{native_platform()}/misbehave{library_suffix()}")
    return path
