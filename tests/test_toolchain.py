"""Does C become a shared library, the same one every time, and is a missing compiler named clearly?"""

import ctypes
import importlib.util
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from fmus import toolchain
from fmus.component import ConfigurationError

SOURCE = """
#include <math.h>
__attribute__((visibility("default"))) double grow(double x) { return exp(x); }
double hidden(double x) { return 2 * x; }
"""
SQUARE = '#include "square.h"\n__attribute__((visibility("default"))) double grow(double x) { return SQUARE(x); }\n'
EXPORTED = "__declspec(dllexport) double grow(double x) { return 2 * x; }\n"

needs_zig = pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="cross-building wants the zig extra")


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CRANKBENCH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def bare_path(tmp_path, monkeypatch):
    """A PATH without any compiler, and neither variable that names one."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("CRANKBENCH_CC", raising=False)
    return folder


def without_ziglang(monkeypatch):
    monkeypatch.setattr(toolchain.importlib.util, "find_spec", lambda name: None)


def grow(library: Path):
    function = ctypes.CDLL(str(library)).grow
    function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double]
    return function


def test_a_compiled_function_computes_what_its_source_says(own_cache):
    # One unit in the last place: the C library's exp is not bound to round as Python's.
    assert grow(toolchain.compile_shared(SOURCE))(1.0) == pytest.approx(math.e, rel=4e-16)


def test_only_what_is_marked_visible_is_exported(own_cache):
    assert not hasattr(ctypes.CDLL(str(toolchain.compile_shared(SOURCE))), "hidden")


def test_the_same_source_is_built_once(own_cache):
    first = toolchain.compile_shared(SOURCE)
    stamp = first.stat().st_mtime_ns
    assert toolchain.compile_shared(SOURCE) == first
    assert first.stat().st_mtime_ns == stamp


def test_the_bytes_of_a_library_do_not_depend_on_the_folders_it_was_built_in(tmp_path, monkeypatch):
    built = []
    for place in ("one", "another"):
        headers = tmp_path / place / "headers"
        headers.mkdir(parents=True)
        (headers / "square.h").write_text("#define SQUARE(x) ((x) * (x))\n")
        monkeypatch.setenv("CRANKBENCH_CACHE", str(tmp_path / place / "cache"))
        built.append(toolchain.compile_shared(SQUARE, includes=[headers]))
    assert built[0].name == built[1].name
    assert built[0].read_bytes() == built[1].read_bytes()


def test_a_changed_header_gives_another_library(tmp_path, own_cache):
    header = tmp_path / "headers" / "square.h"
    header.parent.mkdir()
    header.write_text("#define SQUARE(x) ((x) * (x))\n")
    assert grow(toolchain.compile_shared(SQUARE, includes=[header.parent]))(3.0) == 9.0
    header.write_text("#define SQUARE(x) ((x) * (x) + 1)\n")
    assert grow(toolchain.compile_shared(SQUARE, includes=[header.parent]))(3.0) == 10.0


def test_multiplications_and_additions_are_not_contracted(own_cache):
    source = '__attribute__((visibility("default"))) double grow(double x) { return x * x - 1.0; }\n'
    x = 1.0 + 2.0**-30
    # Rounded after the product, the last term of x*x = 1 + 2**-29 + 2**-60 is lost; a fused operation would keep it.
    assert grow(toolchain.compile_shared(source))(x) == 2.0**-29


def test_a_refused_source_gives_the_message_of_the_compiler_and_leaves_nothing_behind(own_cache):
    with pytest.raises(toolchain.CompileError, match="undeclared_thing"):
        toolchain.compile_shared("int grow(void) { return undeclared_thing; }\n")
    assert [path for path in own_cache.rglob("*") if path.is_file()] == []


def test_processes_that_build_the_same_at_once_agree(own_cache):
    script = f"from fmus.toolchain import compile_shared\nprint(compile_shared({SOURCE!r}))"
    running = [subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) for _ in range(3)]
    printed = {process.communicate(timeout=120)[0] for process in running}
    assert [process.returncode for process in running] == [0, 0, 0]
    assert len(printed) == 1
    assert grow(Path(printed.pop().strip()))(0.0) == 1.0
    assert [path.suffix for path in (own_cache / "libraries").iterdir()] == [toolchain.library_suffix()]


def test_a_missing_compiler_is_named_with_what_to_install(bare_path, monkeypatch):
    without_ziglang(monkeypatch)
    with pytest.raises(ConfigurationError, match=r"no C compiler.*pip install 'crankbench\[zig\]'"):
        toolchain.find_compiler()


def test_a_compiler_that_is_asked_for_by_name_but_does_not_run_is_an_error(bare_path, monkeypatch):
    monkeypatch.setenv("CRANKBENCH_CC", "no-such-cc -m64")
    with pytest.raises(ConfigurationError, match="CRANKBENCH_CC names 'no-such-cc -m64'"):
        toolchain.find_compiler()


def test_a_cc_that_does_not_answer_is_passed_over(bare_path, monkeypatch):
    for name, answer in (("cc", "exit 1"), ("gcc", "echo gcc of the test")):
        (bare_path / name).write_text(f"#!/bin/sh\n{answer}\n")
        (bare_path / name).chmod(0o755)
    assert toolchain.find_compiler() == toolchain.Compiler((str(bare_path / "gcc"),), "gcc of the test", "cc")


def test_a_foreign_platform_without_zig_says_what_to_install(bare_path, monkeypatch, own_cache):
    without_ziglang(monkeypatch)
    foreign = "aarch64-darwin" if toolchain.native_platform() != "aarch64-darwin" else "linux64"
    with pytest.raises(ConfigurationError, match="other platforms wants the zig compiler"):
        toolchain.compile_shared(SOURCE, platform=foreign)


def test_an_unknown_platform_is_refused_with_the_known_ones():
    with pytest.raises(ConfigurationError, match="'solaris'; there are native, linux64"):
        toolchain.platform_name("solaris")


@pytest.mark.parametrize(("fmi2", "fmi3"), toolchain.FMI3_PLATFORMS.items())
def test_a_platform_goes_by_its_names_in_both_standards(fmi2, fmi3):
    assert toolchain.platform_name(fmi2) == toolchain.platform_name(fmi3) == fmi2


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="the superuser writes everywhere")
def test_a_read_only_cache_folder_is_named_with_the_remedy(tmp_path, monkeypatch):
    tmp_path.chmod(0o500)
    monkeypatch.setenv("CRANKBENCH_CACHE", str(tmp_path))
    with pytest.raises(ConfigurationError, match="read-only; set CRANKBENCH_CACHE"):
        toolchain.cache_folder()


def test_a_cache_folder_that_cannot_be_made_is_named_with_the_remedy(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("CRANKBENCH_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(ConfigurationError, match=r"cannot keep builds in .*; set CRANKBENCH_CACHE"):
        toolchain.cache_folder()


@needs_zig
def test_zig_builds_where_there_is_no_other_compiler(bare_path, own_cache):
    assert toolchain.find_compiler().kind == "zig"
    assert grow(toolchain.compile_shared(SOURCE))(1.0) == pytest.approx(math.e, rel=4e-16)


@needs_zig
@pytest.mark.parametrize(
    ("platform", "magic", "processor"),
    [
        ("linux64", b"\x7fELF", (18, b"\x3e\x00")),
        ("aarch64-linux", b"\x7fELF", (18, b"\xb7\x00")),
        ("darwin64", b"\xcf\xfa\xed\xfe", (4, b"\x07\x00\x00\x01")),
        ("aarch64-darwin", b"\xcf\xfa\xed\xfe", (4, b"\x0c\x00\x00\x01")),
        pytest.param("win64", b"MZ", None, marks=pytest.mark.slow),  # minutes where zig's own cache is empty
    ],
)
def test_zig_builds_for_the_named_platform(platform, magic, processor, own_cache):
    library = toolchain.compile_shared(EXPORTED if platform == "win64" else SOURCE, platform=platform)
    data = library.read_bytes()
    assert data.startswith(magic)
    if processor:
        offset, value = processor
        assert data[offset : offset + len(value)] == value
    assert [path.name for path in library.parent.iterdir()] == [library.name]


@needs_zig
def test_a_linux_library_of_zig_asks_for_no_newer_glibc_than_2_17(own_cache):
    asked = re.findall(rb"GLIBC_2\.(\d+)", toolchain.compile_shared(SOURCE, platform="linux64").read_bytes())
    assert asked and max(map(int, asked)) <= 17
