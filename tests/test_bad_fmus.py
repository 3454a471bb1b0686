"""Every kind of bad FMU is refused before a run, by a message that names what is wrong, and writes nothing."""

from __future__ import annotations

import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from fuzz_fmus import entries_of, fuzz
from third_party import reference_fmu

from fmus.component import ConfigurationError
from fmus.fmu import describe, load_fmu
from fmus.toolchain import cache_folder, compile_shared, native_platform
from harness.cli import main

Entries = dict[str, bytes]
XML = "modelDescription.xml"


@pytest.fixture(scope="module")
def real() -> dict[int, Entries]:
    """A Reference FMU of each version, with the binary of this platform alone."""
    return {version: entries_of(reference_fmu("VanDerPol", version)) for version in (2, 3)}


@pytest.fixture(autouse=True)
def cache(real: dict[int, Entries], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own for each test, but for what was compiled and downloaded before."""
    common, own = cache_folder(), tmp_path / "cache"
    own.mkdir()
    for name in ("libraries", "downloads"):
        (common / name).mkdir(exist_ok=True)
        (own / name).symlink_to(common / name, target_is_directory=True)
    monkeypatch.setenv("CRANKBENCH_CACHE", str(own))
    return own


@pytest.fixture
def crankbench(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Calls the command line in this process: (exit code, stderr)."""

    def call(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["crankbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        return int(ended.value.code or 0), capsys.readouterr().err

    return call


def packed(path: Path, entries: Entries) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in entries.items():
            file.writestr(name, content)
    return path


def described(entries: Entries, old: str, new: str) -> Entries:
    """The entries with a model description in which the pattern `old` is replaced once."""
    text, count = re.subn(old, new, entries[XML].decode(), count=1, flags=re.DOTALL)
    assert count == 1, f"the description holds {old}"
    return {**entries, XML: text.encode()}


def binary(entries: Entries, content: bytes | None) -> Entries:
    """The entries with another binary, or none."""
    (name,) = [name for name in entries if name.startswith("binaries/")]
    return {**{key: value for key, value in entries.items() if key != name}, **({name: content} if content else {})}


DOCTYPE = r"\g<0><!DOCTYPE x "
DESCRIPTIONS = {
    "malformed": (2, "</fmiModelDescription>", "</fmi>", "is not XML"),
    "empty": (2, "<fmiModelDescription.*", "", "is not XML"),
    "another root": (2, "fmiModelDescription(.*)fmiModelDescription", r"model\1model", "wants the element fmiModel"),
    "entity expansion": (
        2,
        r"<\?xml.*?\?>",
        DOCTYPE + '[<!ENTITY a "aa"><!ENTITY b "&a;&a;&a;&a;">]>',
        "declares a document type or entities",
    ),
    "external entity": (
        2,
        r"<\?xml.*?\?>",
        DOCTYPE + '[<!ENTITY a SYSTEM "file:///etc/passwd">]>',
        "declares a document type or entities",
    ),
    "external document type": (
        3,
        r"<\?xml.*?\?>",
        DOCTYPE + 'SYSTEM "http://localhost:9/x.dtd">',
        "declares a document type or entities",
    ),
    "unknown version": (2, 'fmiVersion="2.0"', 'fmiVersion="2.5"', "wants an fmiVersion .* got '2.5'"),
    "future version": (3, 'fmiVersion="3.0"', 'fmiVersion="4.0"', "wants an fmiVersion .* got '4.0'"),
    "no version": (2, 'fmiVersion="2.0"', "", "wants an fmiVersion .* got none"),
    "no guid": (2, 'guid=".*?"', "", "has no guid"),
    "no token": (3, 'instantiationToken=".*?"', "", "has no instantiationToken"),
    "value reference taken twice": (
        3,
        'name="x1" valueReference="3"',
        'name="x1" valueReference="1"',
        "the valueReference 1 is that of several variables: x0, x1",
    ),
    "value reference of two start values": (
        2,
        'name="x1" valueReference="3"',
        'name="x1" valueReference="1"',
        "the valueReference 1 is that of several variables: x0, x1",
    ),
    "no value reference": (2, 'name="x0" valueReference="1"', 'name="x0"', "x0 .line .* has no valueReference"),
    "value reference no number": (
        3,
        'name="x0" valueReference="1"',
        'name="x0" valueReference="one"',
        "x0 .line .* wants a valueReference from 0 to 4294967295, got 'one'",
    ),
    "value reference too large": (
        2,
        'name="x0" valueReference="1"',
        'name="x0" valueReference="4294967296"',
        "wants a valueReference from 0 to 4294967295",
    ),
    "identifier that leads elsewhere": (
        2,
        'modelIdentifier="VanDerPol"',
        'modelIdentifier="../../../../escaped"',
        "wants a modelIdentifier that can name the binary",
    ),
    "no type": (2, '<Real start="2"[^>]*>', "", "x0 .line .* wants a type of FMI 2, got none"),
    "type of another version": (3, '<Float64 name="x0"', '<Real name="x0"', "wants a type of FMI 3, got 'Real'"),
    "start value no number": (2, 'start="2"', 'start="two"', "x0 wants numbers, got 'two'"),
    "neither kind": (2, "<ModelExchange.*</CoSimulation>", "", "neither Co-Simulation nor Model Exchange"),
}


@pytest.mark.parametrize("case", DESCRIPTIONS)
def test_a_bad_model_description_is_refused_with_its_reason(case: str, real: dict[int, Entries], tmp_path: Path):
    version, old, new, told = DESCRIPTIONS[case]
    path = packed(tmp_path / "bad.fmu", described(real[version], old, new))
    for read in (describe, load_fmu):
        with pytest.raises(ConfigurationError, match=told):
            read(path)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8-sig"])
def test_entities_are_refused_in_every_encoding(encoding: str, real: dict[int, Entries], tmp_path: Path):
    text = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]>{real[2][XML].decode().partition("?>")[2]}'
    path = packed(tmp_path / "bad.fmu", {**real[2], XML: text.encode(encoding)})
    with pytest.raises(ConfigurationError, match=r"declares a document type or entities|is not XML"):
        describe(path)


def test_entities_in_a_build_description_are_refused(real: dict[int, Entries], tmp_path: Path):
    text = b'<!DOCTYPE x [<!ENTITY a "b">]><fmiBuildDescription fmiVersion="3.0">&a;</fmiBuildDescription>'
    path = packed(tmp_path / "bad.fmu", {**real[3], "sources/buildDescription.xml": text})
    with pytest.raises(ConfigurationError, match=r"buildDescription\.xml declares a document type"):
        describe(path)


def test_a_description_nested_deep_is_refused(real: dict[int, Entries], tmp_path: Path):
    nested = real[2][XML].replace(b"</fmiModelDescription>", b"<a>" * 100_000 + b"</a>" * 100_000)
    path = packed(tmp_path / "bad.fmu", {**real[2], XML: nested + b"</fmiModelDescription>"})
    with pytest.raises(ConfigurationError, match="nested more than"):
        describe(path)


def test_an_array_that_no_memory_holds_is_refused(tmp_path: Path):
    entries = entries_of(reference_fmu("StateSpace", 3))
    path = packed(tmp_path / "bad.fmu", described(entries, 'name="n"(.*?)start="3"', r'name="n"\1start="2000000000"'))
    with pytest.raises(ConfigurationError, match="scalars in its arrays"):
        describe(path)


def test_an_array_with_another_number_of_start_values_is_refused(tmp_path: Path):
    entries = described(entries_of(reference_fmu("StateSpace", 3)), 'start="1 2 3"', 'start="1 2"')
    with pytest.raises(ConfigurationError, match="u wants 3 start values, got 2"):
        describe(packed(tmp_path / "bad.fmu", entries))


def test_aliases_of_one_value_are_no_clash(real: dict[int, Entries], tmp_path: Path):
    twin = '<ScalarVariable name="twin" valueReference="1"><Real/></ScalarVariable>'
    entries = described(real[2], "</ModelVariables>", twin + "</ModelVariables>")
    component = load_fmu(packed(tmp_path / "fine.fmu", entries))
    assert component.description.runnable
    component.close()


def test_a_missing_binary_is_refused_with_what_is_there(real: dict[int, Entries], tmp_path: Path):
    path = packed(tmp_path / "bad.fmu", {**binary(real[2], None), "binaries/win32/VanDerPol.dll": b"MZ"})
    with pytest.raises(ConfigurationError, match=f"no binary for {native_platform()}; it has win32"):
        load_fmu(path)


ELF = b"\x7fELF"
BINARIES = {
    "32-bit": (
        ELF + b"\x01\x01\x01" + bytes(9) + b"\x03\x00\x03\x00" + bytes(100),
        "is 32-bit for linux on x86, not for",
    ),
    "another machine": (ELF + b"\x02\x01\x01" + bytes(9) + b"\x03\x00\xb7\x00" + bytes(100), "for linux on aarch64"),
    "another system": (b"MZ" + bytes(58) + b"\x40\0\0\0PE\0\0\x4c\x01" + bytes(100), "is 32-bit for windows on x86"),
    "no library": (b"echo hello", "is no shared library"),
}


@pytest.mark.skipif(
    native_platform() != "linux64", reason="the binaries below are wrong for this platform in other ways"
)
@pytest.mark.parametrize("case", BINARIES)
def test_a_binary_for_another_machine_is_refused_without_loading_it(
    case: str, real: dict[int, Entries], tmp_path: Path
):
    content, told = BINARIES[case]
    path = packed(tmp_path / "bad.fmu", binary(real[2], content))
    assert re.search(told, "; ".join(describe(path).reasons))
    with pytest.raises(ConfigurationError, match=told):
        load_fmu(path)


@pytest.mark.skipif(native_platform() != "linux64", reason="the segments of ELF files are looked at")
def test_a_binary_that_was_cut_short_is_refused_without_loading_it(real: dict[int, Entries], tmp_path: Path):
    (content,) = [value for name, value in real[2].items() if name.startswith("binaries/")]
    with pytest.raises(ConfigurationError, match="is cut short"):
        load_fmu(packed(tmp_path / "bad.fmu", binary(real[2], content[: len(content) // 2])))


@pytest.mark.parametrize("version", [2, 3])
def test_a_binary_that_lacks_a_function_is_refused_with_its_name(
    version: int, real: dict[int, Entries], tmp_path: Path
):
    library = compile_shared('__attribute__((visibility("default"))) int nothing_of_use(void) { return 0; }')
    with pytest.raises(ConfigurationError, match=rf"fmi{version}\w+"):
        load_fmu(packed(tmp_path / "bad.fmu", binary(real[version], library.read_bytes())))


@pytest.mark.skipif(native_platform() != "linux64", reason="the name of the library is put into an ELF file")
def test_a_binary_that_wants_a_library_that_is_not_there_is_refused_with_its_name(
    real: dict[int, Entries], tmp_path: Path
):
    (content,) = [value for name, value in real[2].items() if name.startswith("binaries/")]
    changed = content.replace(b"libc.so.6\0", b"libx.so.6\0")
    assert changed != content
    with pytest.raises(ConfigurationError, match=r"libx\.so\.6"):
        load_fmu(packed(tmp_path / "bad.fmu", binary(real[2], changed)))


CAMPAIGN = """\
campaign: bad
clock: {{time: {{step: 10 ms, stop: 0.1 s}}}}
parts:
  source: {{use: source, unit: "1", constant: 1}}
  plant: {{use: {fmu}{more}}}
"""


def campaign(folder: Path, fmu: Path, more: str = "") -> Path:
    file = folder / "bad.yaml"
    file.write_text(CAMPAIGN.format(fmu=fmu, more=more))
    return file


@pytest.mark.parametrize(
    ("version", "attribute"),
    [(2, "guid"), (3, "instantiationToken")],
)
def test_a_token_that_is_not_the_binarys_ends_a_run_before_it_begins(
    version: int,
    attribute: str,
    real: dict[int, Entries],
    tmp_path: Path,
    crankbench: Callable[..., tuple[int, str]],
):
    entries = described(real[version], f'{attribute}=".*?"', f'{attribute}="another"')
    file = campaign(tmp_path, packed(tmp_path / "bad.fmu", entries))
    code, said = crankbench("run", file, "--out", tmp_path / "out")
    assert (code, (tmp_path / "out").exists()) == (2, False)
    assert attribute.lower() in said.lower()


BAD: dict[str, Callable[[Entries, Path], Path]] = {
    "not a zip": lambda real, path: path.write_bytes(b"hello") and path,
    "truncated": lambda real, path: path.write_bytes(packed(path, real).read_bytes()[:-30]) and path,
    "traversal": lambda real, path: packed(path, {**real, "../../escaped": b"x"}),
    "absolute": lambda real, path: packed(path, {**real, "/tmp/escaped": b"x"}),
    "drive": lambda real, path: packed(path, {**real, "C:\\escaped": b"x"}),
    "bomb": lambda real, path: packed(path, {**real, "bomb": bytes(100 << 20)}),
    "no description": lambda real, path: packed(path, {"readme": b"x"}),
    "malformed": lambda real, path: packed(path, {**real, XML: b"<fmiModelDescription"}),
    "entities": lambda real, path: packed(path, {**real, XML: b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>'}),
    "no binary": lambda real, path: packed(path, binary(real, None)),
}
TOLD = {
    "not a zip": "is no intact zip archive",
    "truncated": "is no intact zip archive",
    "traversal": "leads outside",
    "absolute": "leads outside",
    "drive": "leads outside",
    "bomb": "more bytes than are taken",
    "no description": "wants a modelDescription.xml",
    "malformed": "is not XML",
    "entities": "declares a document type or entities",
    "no binary": "no binary for",
}


@pytest.mark.parametrize("case", BAD)
def test_the_command_line_refuses_a_bad_fmu_and_writes_nothing(
    case: str, real: dict[int, Entries], tmp_path: Path, cache: Path, crankbench: Callable[..., tuple[int, str]]
):
    folder = tmp_path / "a" / "b"
    folder.mkdir(parents=True)
    fmu = BAD[case](real[2], folder / "bad.fmu")
    file = campaign(folder, fmu)
    before = {path for path in tmp_path.rglob("*") if cache not in path.parents}
    commands = [("run", file, "--out", folder / "out"), ("check", fmu)]
    for command in commands if case == "no binary" else [*commands, ("inspect", fmu)]:
        code, said = crankbench(*command)
        assert code == 2, f"{command[0]} of {case} says {said}"
        assert TOLD[case] in said, f"{command[0]} of {case} says {said}"
    after = {path for path in tmp_path.rglob("*") if cache not in path.parents}
    assert after <= before | {cache}
    assert not list((cache / "unpacked").glob(".*"))


def test_a_text_wired_to_a_number_is_refused(tmp_path: Path, crankbench: Callable[..., tuple[int, str]]):
    file = campaign(tmp_path, reference_fmu("Feedthrough", 3), ", wires: {String_input: source, Binary_input: source}")
    code, said = crankbench("run", file, "--out", tmp_path / "out")
    assert (code, (tmp_path / "out").exists()) == (2, False)
    assert "Binary_input: is of the type Binary, which no wire carries" in said
    assert "String_input: is of the type String, which no wire carries" in said


def test_an_array_wired_to_another_size_is_refused(tmp_path: Path, crankbench: Callable[..., tuple[int, str]]):
    fmu = reference_fmu("StateSpace", 3)
    file = campaign(tmp_path, fmu, ", wires: {u: other.y}")
    file.write_text(file.read_text() + f"  other: {{use: {fmu}, with: {{r: 2}}, wires: {{u: source}}}}\n")
    code, said = crankbench("run", file, "--out", tmp_path / "out")
    assert (code, (tmp_path / "out").exists()) == (2, False)
    assert "plant.wires.u wants an array of 3 values, got an array of 2 values from other.y" in said
    assert "other.wires.u wants an array of 3 values, got the single value source" in said


def test_an_array_given_another_number_of_values_is_refused(tmp_path: Path, crankbench: Callable[..., tuple[int, str]]):
    file = campaign(tmp_path, reference_fmu("StateSpace", 3), ", with: {x0: [1, 2]}, wires: {u: plant.y}")
    code, said = crankbench("run", file, "--out", tmp_path / "out")
    assert (code, (tmp_path / "out").exists()) == (2, False)
    assert "plant.with.x0 wants 3 values, shape (3,), got 2" in said


def test_the_command_line_of_a_bad_fmu_ends_with_the_code_2_in_a_process_of_its_own(tmp_path: Path):
    (tmp_path / "bad.fmu").write_bytes(b"hello")
    command = [sys.executable, "-m", "harness", "inspect", str(tmp_path / "bad.fmu")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert len(result.stderr.splitlines()) == 1


def test_fmus_changed_at_random_are_read_or_refused():
    fuzz(examples=40, start=0)
