"""The C translation unit of an exported model: tables, CasADi's functions, and the fixed runtime."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import casadi as ca

from fmus.interface import Interface, Variable
from fmus.model import ModelError
from fmus.tracing import Traced

RUNTIME = Path(__file__).parent / "runtime"
_KINDS = {"real": "REAL", "integer": "INTEGER", "boolean": "BOOLEAN"}
_ARGUMENTS = ("t", "x", "m", "u", "p")


def _functions(traced: Traced) -> list[ca.Function]:
    """Every function that runtime/instance.h asks of a model, over flat vectors."""
    inputs = traced.equations.sx_in()
    t, x, _, u, p = inputs
    dx, y = traced.equations.call(inputs)
    (z,) = traced.indicators.call(inputs)
    above = ca.SX.sym("above", z.numel())
    sx, su, sp = (ca.SX.sym(f"s{name}", v.numel()) for name, v in (("x", x), ("u", u), ("p", p)))
    ldx, ly = ca.SX.sym("ldx", dx.numel()), ca.SX.sym("ly", y.numel())
    both, knowns = ca.vertcat(dx, y), ca.vertcat(x, u, p)
    forward = ca.jtimes(both, knowns, ca.vertcat(sx, su, sp))
    reverse = ca.jtimes(both, knowns, ca.vertcat(ldx, ly), True)
    nx, nu = x.numel(), u.numel()
    dz = ca.jtimes(z, x, dx) + ca.jtimes(z, t, ca.SX(1))
    results: list[tuple[str, Sequence[Any], Sequence[Any]]] = [
        ("derivatives", [], [dx]),
        ("outputs", [], [y]),
        ("indicators", [], [z]),
        ("indicator_rates", [], [dz]),
        ("jacobian", [], [ca.jacobian(dx, x).T, ca.jacobian(dx, t)]),
        ("transition", [above], list(traced.transition.call([*inputs, above]))),
        ("sample", [], list(traced.sample.call(inputs))),
        ("forward", [sx, su, sp], [forward[: dx.numel()], forward[dx.numel() :]]),
        ("reverse", [ldx, ly], [reverse[:nx], reverse[nx : nx + nu], reverse[nx + nu :]]),
    ]
    return [
        ca.Function(f"traced_{name}", [*inputs, *more], [ca.densify(expression) for expression in ca.cse(list(given))])
        for name, more, given in results
    ]


def _traced_code(functions: Sequence[ca.Function]) -> str:
    generator = ca.CodeGenerator("traced.c", {"with_header": False, "prefix": "traced_", "casadi_int": "int"})
    for function in functions:
        generator.add(function)
    code: str = generator.dump()
    if re.search(r"\bi?w\[", code):
        raise ModelError("the generated code asks for work memory, which the runtime does not give")
    # Of the interface that CasADi writes around each function only the function itself is needed.
    bodies = re.findall(r"/\* traced_\w+:.*?^}$", code, re.S | re.M)
    names = re.findall(
        r"CASADI_SYMBOL_EXPORT int (traced_\w+)\(const casadi_real\*\* arg[^{]*\{\s*return (\w+)\(", code
    )
    constants = re.findall(r"^(?:static const casadi_real \w+\[.*?;|#define casadi_[cf]\d+ .*)$", code, re.M)
    helpers = re.findall(r"^(?:static )?casadi_real casadi_\w+\([^\n]*(?:\}|\{\n.*?^\})$", code, re.S | re.M)
    if len(bodies) != len(functions) or len(names) != len(functions):
        raise ModelError("CasADi's generated code has a shape this version does not know")
    parts = [
        "#define casadi_real double",
        "#define casadi_int int",
        *[line for line in constants if line.startswith("static")],
        *[helper if helper.startswith("static") else f"static inline {helper}" for helper in helpers],
        *[re.sub(r"^static int", "static inline int", body, flags=re.M) for body in bodies],
        *[f"#define {public} {inner}" for public, inner in names],
    ]
    return "\n\n".join(parts)


def _wrapper(function: ca.Function, name: str, more: Sequence[str], results: Sequence[str]) -> str:
    arguments = ", ".join(f"const double *{argument}" for argument in (*_ARGUMENTS[1:], *more))
    written = ", ".join(f"double *{result}" for result in results)
    unused = "".join(f"(void){argument}; " for argument in (*_ARGUMENTS, *more, *results))
    return (
        f"static void model_{name}(double t, {arguments}, {written}) {{\n"
        f"    const double *arg[] = {{&t, {', '.join((*_ARGUMENTS[1:], *more))}}};\n"
        f"    double *res[] = {{{', '.join(results)}}};\n"
        f"    {unused}\n"
        f"    traced_{name}(arg, res, 0, 0, 0);\n"
        f"}}"
    )


_WRAPPED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "derivatives": ((), ("dx",)),
    "outputs": ((), ("y",)),
    "indicators": ((), ("z",)),
    "indicator_rates": ((), ("dz",)),
    "jacobian": ((), ("jx", "jt")),
    "transition": (("above",), ("xn", "mn")),
    "sample": ((), ("xn", "mn")),
    "forward": (("sx", "su", "sp"), ("sdx", "sy")),
    "reverse": (("ldx", "ly"), ("lx", "lu", "lp")),
}


def _number(value: float) -> str:
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


def _table(declaration: str, entries: Sequence[str]) -> str:
    return f"static const {declaration} = {{\n    " + ",\n    ".join(entries) + "\n};"


def _text(value: str) -> str:
    return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _tables(variables: Sequence[Variable], nominals: Sequence[float]) -> list[str]:
    return [
        _table("char *const model_name[NV]", [_text(variable.name) for variable in variables]),
        _table("unsigned char model_kind[NV]", [_KINDS[variable.kind] for variable in variables]),
        _table("unsigned char model_settable[NV]", [str(variable.settable) for variable in variables]),
        _table("double model_start[NV]", [_number(variable.start) for variable in variables]),
        _table("double model_nominal[NX + 1]", [*[_number(value) for value in nominals], "1.0"]),
    ]


def token(text: str) -> str:
    """An instantiation token (GUID) from the content it stands for."""
    digest = hashlib.sha256(text.encode()).hexdigest()
    return "{" + "-".join((digest[:8], digest[8:12], digest[12:16], digest[16:20], digest[20:32])) + "}"


def model_source(traced: Traced, interface: Interface, fmi: int) -> tuple[str, str]:
    """The text of model.c for FMI 2 or 3, and the instantiation token that it checks.

    It includes the files of the runtime folder, and with them is one translation unit.
    """
    model, sizes = traced.model, interface.sizes
    functions = _functions(traced)
    defines = [f"#define N{name} {size}" for name, size in sizes.items() if name != "DX"]
    sampled = model.sample is not None
    defines.append(f"#define SAMPLED {int(sampled)}")
    if sampled:
        names = [variable.name for variable in interface.variables]
        defines.append(f"#define SAMPLE_TIME {names.index(model.sample_time)}")
    wrappers = [_wrapper(function, name, *_WRAPPED[name]) for function, name in zip(functions, _WRAPPED, strict=True)]
    nominals = [interface.variables[reference].nominal for reference in interface.block("X")]
    body = "\n\n".join(
        [
            "\n".join(defines),
            '#include "instance.h"',
            *_tables(interface.variables, nominals),
            _traced_code(functions),
            *wrappers,
            f'#include "instance.c"\n#include "solve.c"\n#include "fmi{fmi}.c"',
        ]
    )
    runtime = "".join(path.read_text() for path in sorted(RUNTIME.glob("*.[ch]")))
    found = token(body + runtime)
    comment = f"/* {model.name}: generated from its Python source; {model.description.replace('*/', '')} */"
    return f'{comment}\n#define MODEL_TOKEN "{found}"\n{body}\n', found
