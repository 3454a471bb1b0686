"""Changes real FMUs at random, in their model descriptions and in their bytes: each is read or refused, never worse.

`python tests/fuzz_fmus.py --minutes 10` runs longer than the test suite does.
"""

from __future__ import annotations

import argparse
import copy
import faulthandler
import io
import json
import os
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from xml.etree import ElementTree

from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from third_party import third_party_fmu

from fmus.component import ConfigurationError
from fmus.description import describe
from fmus.fmu import load_fmu
from fmus.toolchain import FMI3_PLATFORMS, cache_folder, native_platform

LONGEST = 20.0  # s for one FMU: reading one takes some hundredths
MEMORY = 4 << 30
BASES = (
    ("reference/fmi2/BouncingBall.fmu", 2),
    ("reference/fmi2/Feedthrough.fmu", 2),
    ("reference/fmi3/StateSpace.fmu", 3),
    ("reference/fmi3/Feedthrough.fmu", 3),
)
VALUES = (
    *("", " ", "0", "1", "-1", "+1", "00", "2147483648", "4294967295", "4294967296", "18446744073709551616", "9" * 50),
    *("1e400", "-1e400", "NaN", "INF", "-INF", "inf", "0x10", "1_0", "1.5", "\uff11", "true", "false", "TRUE", "1 2 3"),
    *(
        "x" * 70_000,
        "../../../../escaped",
        "/escaped",
        "..\\escaped",
        "C:\\escaped",
        "a/b",
        "%s%n",
        "\u20ac",
        "\U0001f600",
    ),
    *("input", "output", "parameter", "structuralParameter", "calculatedParameter", "independent", "local", "constant"),
    *("fixed", "tunable", "discrete", "continuous", "exact", "approx", "calculated", "1.0", "2.0", "3.0", "3.9", "4.0"),
    *("rpm", "degC", "m/0", "N.m", "Real", "Float64", "Binary", "Clock", "1000000000", "65536"),
)
NAMES = (
    *("name", "valueReference", "causality", "variability", "initial", "start", "unit", "declaredType", "min", "max"),
    *("nominal", "derivative", "index", "dependencies", "dependenciesKind", "fmiVersion", "guid", "instantiationToken"),
    *("modelIdentifier", "clocks", "alias", "relativeQuantity", "factor", "offset", "numberOfEventIndicators", "xmlns"),
)
TAGS = (
    *("ScalarVariable", "Real", "Integer", "Boolean", "String", "Enumeration", "Float64", "Int32", "UInt64", "Binary"),
    *("Clock", "Dimension", "Alias", "Start", "Unknown", "Output", "ModelVariables", "ModelStructure", "CoSimulation"),
    *(
        "ModelExchange",
        "UnitDefinitions",
        "Unit",
        "BaseUnit",
        "TypeDefinitions",
        "SimpleType",
        "Item",
        "Implementation",
    ),
)
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32", "latin-1", "ascii", "utf-7", "cp037", "shift_jis")
ENTRIES = (
    *("../escaped", "..\\escaped", "a/../../escaped", "/escaped", "C:\\escaped", "a/C:/escaped", ".", "./", "", "a//b"),
    *("modelDescription.xml", "./modelDescription.xml", ".\\modelDescription.xml", "modelDescription.xml/x", "x\0y"),
    *(
        "CON",
        "a:b",
        "\u20ac",
        "x" * 300,
        "binaries",
        "resources/../../escaped",
        " ",
        "~",
        "sources/buildDescription.xml",
    ),
)


def entries_of(fmu: Path) -> dict[str, bytes]:
    """What is needed of an FMU here: its description, its build description and the binary for this machine."""
    native = native_platform()
    wanted = (f"binaries/{native}/", f"binaries/{FMI3_PLATFORMS.get(native, native)}/")
    with zipfile.ZipFile(fmu) as archive:
        return {
            name: archive.read(name)
            for name in archive.namelist()
            if not name.endswith("/") and (name.endswith("Description.xml") or name.startswith(wanted))
        }


def packed(entries: list[tuple[str, bytes]]) -> bytes:
    """An archive of these entries, some of which may have one name."""
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w") as archive:
        for name, content in entries:
            info = zipfile.ZipInfo("x")
            info.filename = name
            info.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(info, content, compresslevel=1)
    return target.getvalue()


@st.composite
def descriptions(draw: st.DrawFn, original: bytes) -> bytes:
    """A model description with one to five changes to its elements, its encoding or its bytes."""
    tree = ElementTree.fromstring(original)
    for _ in range(draw(st.integers(0, 4))):
        _change(draw, tree)
    text = ElementTree.tostring(tree, encoding="unicode")
    if draw(st.integers(0, 3)) == 0:
        text = _disturbed(draw, text)
    written, told = "utf-8", "UTF-8"
    if draw(st.integers(0, 3)) == 0:
        written, told = draw(st.sampled_from(ENCODINGS)), draw(st.sampled_from((*ENCODINGS, "nonsense", "")))
    content = (f'<?xml version="1.0" encoding="{told}"?>\n' + text).encode(written, "xmlcharrefreplace")
    return _flipped(draw, content) if draw(st.integers(0, 3)) == 0 else content


def _change(draw: st.DrawFn, tree: ElementTree.Element) -> None:
    parents = [element for element in tree.iter() if len(element)]
    if not parents:
        return
    parent = draw(st.sampled_from(parents))
    child = parent[draw(st.integers(0, len(parent) - 1))]
    target = draw(st.sampled_from((tree, parent, child)))
    kind = draw(st.sampled_from(("drop", "duplicate", "move", "tag", "unset", "set", "set", "set", "nest", "empty")))
    if kind == "drop":
        parent.remove(child)
    elif kind == "duplicate":
        parent.extend(copy.deepcopy(child) for _ in range(draw(st.sampled_from((1, 2, 300)))))
    elif kind == "move":
        draw(st.sampled_from(list(tree.iter()))).append(copy.deepcopy(child))
    elif kind == "tag":
        target.tag = draw(st.sampled_from(TAGS))
    elif kind == "unset" and target.attrib:
        del target.attrib[draw(st.sampled_from(sorted(target.attrib)))]
    elif kind == "set":
        name = draw(st.sampled_from((*sorted(target.attrib), *NAMES)))
        target.set(
            name, draw(st.one_of(st.sampled_from(VALUES), st.text(st.characters(codec="utf-8", min_codepoint=32))))
        )
    elif kind == "nest":
        for _ in range(draw(st.sampled_from((1, 70)))):
            target.append(target := ElementTree.Element(child.tag, child.attrib))
    elif kind == "empty":
        target.clear()


def _disturbed(draw: st.DrawFn, text: str) -> str:
    """The text with something in it that a tree cannot hold."""
    inserted = draw(
        st.sampled_from(
            (
                '<!DOCTYPE x [<!ENTITY a "b">]>',
                '<!DOCTYPE x SYSTEM "file:///etc/passwd">',
                "&a;",
                "&#0;",
                "<![CDATA[x]]>",
                "<!-- x -->",
                "<?x y?>",
                "<a",
                "\ufeff",
                "<a>" * 5000 + "</a>" * 5000,
            )
        )
    )
    place = draw(st.sampled_from((0, text.find(">") + 1, draw(st.integers(0, len(text))))))
    return text[:place] + inserted + text[place:]


def _flipped(draw: st.DrawFn, content: bytes) -> bytes:
    """The bytes with some changed, cut off or put in."""
    changed = bytearray(content)
    kind = draw(st.sampled_from(("flip", "cut", "put", "drop", "end")))
    place = draw(st.integers(0, max(len(changed) - 1, 0)))
    near_end = max(len(changed) - 1 - draw(st.integers(0, 600)), 0)
    if kind == "flip":
        for _ in range(draw(st.integers(1, 8))):
            at = draw(st.one_of(st.integers(0, len(changed) - 1), st.integers(near_end, len(changed) - 1)))
            changed[at] ^= 1 << draw(st.integers(0, 7))
    elif kind == "cut":
        del changed[place:]
    elif kind == "put":
        changed[place:place] = draw(st.binary(max_size=40))
    elif kind == "drop":
        del changed[place : place + draw(st.integers(1, 400))]
    else:
        changed[near_end : near_end + 4] = draw(st.binary(min_size=4, max_size=4))
    return bytes(changed)


@st.composite
def archives(draw: st.DrawFn, entries: dict[str, bytes]) -> bytes:
    """An archive with changed names, changed entries or changed bytes."""
    listed = list(entries.items())
    for _ in range(draw(st.integers(0, 2))):
        place = draw(st.integers(0, len(listed) - 1))
        name, content = listed[place]
        kind = draw(st.sampled_from(("rename", "again", "drop", "add", "slashes", "content")))
        if kind == "rename":
            listed[place] = (draw(st.one_of(st.sampled_from(ENTRIES), st.text(min_size=1, max_size=20))), content)
        elif kind == "again":
            listed.append((name, b""))
        elif kind == "drop" and len(listed) > 1:
            del listed[place]
        elif kind == "add":
            listed.append((draw(st.sampled_from(ENTRIES)), draw(st.sampled_from((b"", b"x", bytes(1 << 20))))))
        elif kind == "slashes":
            listed[place] = (draw(st.sampled_from(("", "./", ".\\"))) + name.replace("/", "\\"), content)
        elif kind == "content":
            listed[place] = (name, _flipped(draw, content or b"x"))
    try:
        content = packed(listed)
    except UnicodeEncodeError:  # half a character cannot be put into an archive
        content = packed(list(entries.items()))
    for _ in range(draw(st.integers(0, 2))):
        content = _flipped(draw, content or b"x")
    return content


@contextmanager
def sandbox(binaries: Container[bytes]) -> Iterator[Callable[[bytes], str]]:
    """A function that describes the FMU of some bytes in a cache of its own; it returns the outcome.

    An FMU whose binary is one of `binaries` is loaded too: a changed one is a program that nobody may run unguarded.

    It raises AssertionError where more came of it than a description, a component or a ConfigurationError.
    """
    before = os.environ.get("CRANKBENCH_CACHE")
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        root = Path(name)
        deep = root / "a" / "b" / "c" / "d" / "e" / "f"
        cache = deep / "cache"
        deep.mkdir(parents=True)
        os.environ["CRANKBENCH_CACHE"] = str(cache)
        try:
            yield lambda content: _tried(content, root, deep / "fuzzed.fmu", binaries)
        finally:
            if before is None:
                del os.environ["CRANKBENCH_CACHE"]
            else:
                os.environ["CRANKBENCH_CACHE"] = before


def _tried(content: bytes, root: Path, fmu: Path, binaries: Container[bytes]) -> str:
    fmu.write_bytes(content)
    cache = cache_folder()
    try:
        described = describe(fmu)
        json.dumps(described.to_json(), allow_nan=False)
        outcome = "described"
        if described.library is not None and described.library.read_bytes() in binaries:
            load_fmu(fmu).close()
            outcome = "loaded"
    except ConfigurationError as error:
        assert str(error).strip(), "a refusal says why"
        outcome = "refused"
    unpacked = cache / "unpacked"
    places = [path for path in root.rglob("*") if path.is_file() and unpacked not in path.parents and path != fmu]
    escaped = [path for path in places if cache not in path.parents or "escaped" in path.name]
    assert not escaped, f"files escaped: {escaped}"
    assert not any(path.is_symlink() for path in root.rglob("*")), "links came out of an archive"
    assert all(len(folder.name) == 64 for folder in unpacked.glob("*")), "folders are left half unpacked"
    assert not Path("/escaped").exists(), "a file escaped to the root"
    shutil.rmtree(unpacked, ignore_errors=True)
    return outcome


@contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Raises TimeoutError after so long; what Python cannot interrupt ends the process, with its trace, later."""

    def late(_signal: int, _frame: FrameType | None) -> None:
        raise TimeoutError(f"took longer than {seconds} s")

    if not hasattr(signal, "setitimer"):
        yield
        return
    previous = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(3 * seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)


def fuzz(examples: int, start: int, tell: Callable[[str], None] = lambda outcome: None) -> None:
    """Try so many changed descriptions and so many changed archives, spread over BASES."""
    bases = [entries_of(third_party_fmu(name)) for name, _ in BASES]
    quick = settings(
        max_examples=examples,
        deadline=None,
        database=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    binaries = {content for base in bases for name, content in base.items() if name.startswith("binaries/")}
    with sandbox(binaries) as tried, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zipfile's, of the double names that it is asked to write

        @quick
        @seed(start)
        @given(st.data())
        def description_is_read_or_refused(data: st.DataObject) -> None:
            base = data.draw(st.sampled_from(bases))
            changed = {**base, "modelDescription.xml": data.draw(descriptions(base["modelDescription.xml"]))}
            with deadline(LONGEST):
                tell("description " + tried(packed(list(changed.items()))))

        @quick
        @seed(start)
        @given(st.data())
        def archive_is_read_or_refused(data: st.DataObject) -> None:
            content = data.draw(archives(data.draw(st.sampled_from(bases))))
            with deadline(LONGEST):
                tell("archive " + tried(content))

        description_is_read_or_refused()
        archive_is_read_or_refused()


def _told(error: BaseException) -> str:
    """What went wrong, where, and the end of how to come by it."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/fmus/" in frame.filename]
    where = f"{frames[-1].filename}:{frames[-1].lineno}" if frames else "in the fuzzing itself"
    notes = "\n".join(getattr(error, "__notes__", []))
    return f"{type(error).__name__}: {error} ({where})\n{notes[-3000:]}"


def main() -> None:
    """Fuzz for so many minutes, then say what came of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if os.name == "posix":
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    faulthandler.enable()
    for name, _ in BASES:
        third_party_fmu(name)
    print(f"cache {cache_folder()}", flush=True)
    outcomes: Counter[str] = Counter()
    began, round_number, failures = time.monotonic(), asked.seed, 0
    while time.monotonic() - began < 60.0 * asked.minutes:
        try:
            fuzz(200, round_number, lambda outcome: outcomes.update([outcome]))
        except Exception as error:
            failures += 1
            print(f"seed {round_number}: {_told(error)}", flush=True)
        round_number += 1
        minutes = (time.monotonic() - began) / 60.0
        print(
            f"{minutes:6.1f} min, seeds {asked.seed}..{round_number - 1}: {dict(sorted(outcomes.items()))}", flush=True
        )
    if failures:
        sys.exit(f"{failures} of {round_number - asked.seed} rounds found something")
    print("every FMU was read or refused; no file escaped")


if __name__ == "__main__":
    main()
