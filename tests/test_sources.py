"""FMUs that come as sources are built and run as their binaries do; what cannot be built is told."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from third_party import reference_fmu

from fmus.component import ConfigurationError, Vector
from fmus.description import FmuKind, describe
from fmus.fmu import load_fmu
from fmus.toolchain import native_platform

Change = Callable[[bytes], bytes]


def sources_alone(path: Path, folder: Path, changes: dict[str, Change] | None = None) -> Path:
    """A copy of an FMU without its binaries, with files changed; what a change makes empty is left out."""
    copy = folder / path.name
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(copy, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            change = (changes or {}).get(name)
            content = change(content) if change else content
            if not name.startswith("binaries/") and (content or not change):
                target.writestr(name, content)
    return copy


def trajectory(path: Path, kind: FmuKind) -> Vector:
    component = load_fmu(path, kind=kind)
    u = np.array([signal.start for signal in component.inputs])
    rows = [component.start(0.0, u), *(component.step(k * 0.1, 0.1, u) for k in range(30))]
    component.close()
    return np.array(rows)


@pytest.mark.parametrize("kind", ["cs", "me"])
@pytest.mark.parametrize("fmi", [2, 3])
@pytest.mark.parametrize("model", ["BouncingBall", "VanDerPol"])
def test_what_is_built_from_sources_does_as_the_binary(tmp_path: Path, model: str, fmi: int, kind: FmuKind):
    path = sources_alone(reference_fmu(model, fmi), tmp_path)
    description = describe(path)
    assert description.platforms == ("c-code",) and description.runnable, description.reasons
    built, shipped = trajectory(path, kind), trajectory(reference_fmu(model, fmi), kind)
    # Another compiler may round otherwise; the ball amplifies a rounding at its bounces by some hundred.
    assert np.allclose(built, shipped, rtol=1e-9, atol=1e-9)


def test_a_build_description_is_followed_in_its_definitions(tmp_path: Path):
    def defined(content: bytes) -> bytes:
        entry = b'<PreprocessorDefinition name="ASKED_FOR" value="3"/>'
        return content.replace(b"</SourceFileSet>", entry + b"</SourceFileSet>")

    def demanding(content: bytes) -> bytes:
        return content + b"\n#if ASKED_FOR != 3\n#error not as described\n#endif\n"

    shipped = reference_fmu("Dahlquist", 3)
    changes = {"sources/buildDescription.xml": defined, "sources/model.c": demanding}
    assert trajectory(sources_alone(shipped, tmp_path, changes), "cs").shape == (31, 1)
    (tmp_path / "undefined").mkdir()
    without = sources_alone(shipped, tmp_path / "undefined", {"sources/model.c": demanding})
    with pytest.raises(ConfigurationError, match="not as described"):
        load_fmu(without)


def test_sources_that_cannot_be_built_are_a_reason(tmp_path: Path):
    path = sources_alone(reference_fmu("Dahlquist"), tmp_path, {"sources/all.c": lambda content: b""})
    missing = f"it has no binary for {native_platform()}; it has c-code"
    assert describe(path).reasons == (missing, "its sources lack the file all.c")
    with pytest.raises(ConfigurationError, match="lack the file"):
        load_fmu(path)


def test_a_source_outside_of_the_fmu_is_not_taken(tmp_path: Path):
    def leading_out(content: bytes) -> bytes:
        return content.replace(b'name="all.c"', b'name="../../../all.c"')

    path = sources_alone(reference_fmu("Dahlquist"), tmp_path, {"modelDescription.xml": leading_out})
    assert "its sources lack the file ../../../all.c" in describe(path).reasons
