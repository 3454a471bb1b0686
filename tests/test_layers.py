"""Do imports run one way, does only the edge know FMPy, and does every file say why it exists?"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
# Each package may import itself and those after it; reports reads run folders only, so it imports no harness either.
ORDER = ("reports", "harness", "selection", "observers", "fmus")
REPORTS_READ_FOLDERS_ONLY = {"harness", "selection", "observers"}
# The edge to FMPy: reading a model description, binding and calling the functions of an FMU.
FMPY_EDGE = {"fmus/modeltext.py"}
SAYING_NOTHING = {"utils", "util", "helpers", "helper", "common", "misc", "base", "core", "tools", "shared", "lib"}

FILES = sorted(path for package in ORDER for path in (ROOT / package).rglob("*.py"))
WITH_BENCHMARKS_AND_TESTS = FILES + sorted((ROOT / "benchmarks").rglob("*.py")) + sorted((ROOT / "tests").rglob("*.py"))


def imported(path: Path, source: str) -> Iterator[tuple[int, str]]:
    """Line and full name of every module that a file imports, at the top or inside a function."""
    folder = path.relative_to(ROOT).parent.parts
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = folder[: len(folder) - node.level + 1] if node.level else ()
            yield node.lineno, ".".join([*above, *([node.module] if node.module else [])])


def forbidden(package: str) -> set[str]:
    """The packages that a package must not import."""
    earlier = set(ORDER[: ORDER.index(package)]) | {"tests", "benchmarks"}
    return earlier | REPORTS_READ_FOLDERS_ONLY if package == "reports" else earlier


def against_the_order(path: Path, source: str) -> list[str]:
    """`file:line: import` of each import that runs the wrong way."""
    name = path.relative_to(ROOT).as_posix()
    wrong = forbidden(name.split("/")[0])
    return [
        f"{name}:{line}: imports {module}" for line, module in imported(path, source) if module.split(".")[0] in wrong
    ]


def test_imports_run_one_way():
    assert [line for path in FILES for line in against_the_order(path, path.read_text(encoding="utf-8"))] == []


def test_an_import_against_the_order_is_named_with_its_line():
    source = '"""A plant."""\n\ndef late():\n    from harness.run import run\n'
    assert against_the_order(ROOT / "fmus" / "plants" / "x.py", source) == ["fmus/plants/x.py:4: imports harness.run"]
    assert against_the_order(ROOT / "harness" / "x.py", "import fmus.model\nfrom observers import hybrid\n") == []
    assert against_the_order(ROOT / "reports" / "x.py", "import harness.record") == [
        "reports/x.py:1: imports harness.record"
    ]


def test_only_the_edge_imports_fmpy():
    inside = [
        f"{path.relative_to(ROOT)}:{line}: imports {module}"
        for path in FILES
        if path.relative_to(ROOT).as_posix() not in FMPY_EDGE
        for line, module in imported(path, path.read_text(encoding="utf-8"))
        if module.split(".")[0] == "fmpy"
    ]
    assert inside == []


@pytest.mark.parametrize("path", WITH_BENCHMARKS_AND_TESTS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_module_says_its_reason_first_and_is_named_after_it(path):
    text = path.read_text(encoding="utf-8")
    assert path.stem not in SAYING_NOTHING, "a name that says nothing: name the file after its one reason to exist"
    first = (ast.get_docstring(ast.parse(text)) or "").partition("\n")[0]
    assert first, "the first line of a module is its docstring: the one reason it exists"
    assert first.endswith((".", "?")), f"the first docstring line is a sentence, got: {first}"
