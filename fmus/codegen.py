"""The C translation unit of an exported model: tables, CasADi's functions, and the fixed runtime."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca

from fmus.interface import Interface, Variable
from fmus.model import ModelError
from fmus.tracing import Traced

RUNTIME = Path(__file__).parent / "runtime"
# Inline, and not a number where an argument is none, as np.minimum and np.maximum.
_EXTREMES = """static inline double casadi_fmin(double x, double y) { return x < y || x != x ? x : y; }
static inline double casadi_fmax(double x, double y) { return x > y || x != x ? x : y; }"""
_KINDS = {"real": "REAL", "integer": "INTEGER", "boolean": "BOOLEAN"}
_ARGUMENTS = ("t", "x", "m", "u", "p", "c")


@dataclass(frozen=True)
class _Hoisted:
    """Expressions rewritten so that what depends on parameters alone is an input of its own, c = constants(p)."""

    expressions: list[Any]
    symbols: Any
    constants: Any


def _hoist(inputs: Sequence[Any], parameters: Any, expressions: Sequence[Any]) -> _Hoisted:
    """Take out of the expressions the largest subexpressions of parameters alone: they change only when those do.

    The operations and their order stay as they were, so every result stays the same bit for bit.
    """
    function = ca.Function("whole", list(inputs), ca.cse(list(expressions)))
    place = next(index for index, symbol in enumerate(inputs) if symbol is parameters)
    work: dict[int, tuple[Any, bool, bool]] = {}  # expression, of parameters alone, computed
    results = [ca.SX.zeros(function.sparsity_out(i)) for i in range(function.n_out())]
    symbols: list[Any] = []
    constants: list[Any] = []
    known: dict[int, Any] = {}

    def outside(entry: tuple[Any, bool, bool]) -> Any:
        expression, alone, computed = entry
        if not (alone and computed):
            return expression
        key = expression.element_hash()
        if key not in known:
            known[key] = ca.SX.sym(f"c{len(symbols)}")
            symbols.append(known[key])
            constants.append(expression)
        return known[key]

    for k in range(function.n_instructions()):
        operation = function.instruction_id(k)
        sources, targets = function.instruction_input(k), function.instruction_output(k)
        if operation == ca.OP_INPUT:
            work[targets[0]] = (inputs[sources[0]].nz[sources[1]], sources[0] == place, False)
        elif operation == ca.OP_CONST:
            work[targets[0]] = (ca.SX(function.instruction_constant(k)), True, False)
        elif operation == ca.OP_OUTPUT:
            results[targets[0]].nz[targets[1]] = outside(work[sources[0]])
        else:
            operands = [work[source] for source in sources]
            alone = all(operand[1] for operand in operands)
            values = [operand[0] if alone else outside(operand) for operand in operands]
            applied = ca.SX.unary(operation, *values) if len(values) == 1 else ca.SX.binary(operation, *values)
            work[targets[0]] = (applied, alone, True)
    return _Hoisted(results, ca.vertcat(*symbols), ca.vertcat(*constants))


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
    given: list[tuple[str, Sequence[Any], Sequence[Any]]] = [
        ("derivatives", [], [dx]),
        ("outputs", [], [y]),
        ("indicators", [], [z]),
        ("indicator_rates", [], [dz]),
        ("jacobian", [], [ca.jacobian(dx, x).T, ca.jacobian(dx, t)]),
        ("transition", [above], list(traced.transition.call([*inputs, above]))),
        *_sampling(traced, inputs),
        ("forward", [sx, su, sp], [forward[: dx.numel()], forward[dx.numel() :]]),
        ("reverse", [ldx, ly], [reverse[:nx], reverse[nx : nx + nu], reverse[nx + nu :]]),
    ]
    flat = [ca.densify(expression) for _, _, results in given for expression in results]
    hoisted = _hoist([*inputs, above, sx, su, sp, ldx, ly], p, flat)
    rewritten = iter(hoisted.expressions)
    functions = [ca.Function("traced_constants", [p], [ca.densify(hoisted.constants)])]
    for name, more, results in given:
        expressions = [ca.densify(next(rewritten)) for _ in results]
        functions.append(ca.Function(f"traced_{name}", [*inputs, hoisted.symbols, *more], expressions))
    return functions


def _sampling(traced: Traced, inputs: Sequence[Any]) -> list[tuple[str, Sequence[Any], Sequence[Any]]]:
    """What is sampled, or the functions that the kernel calls for it, with their Jacobians by x."""
    if traced.model.kernel is None:
        return [("sample", [], list(traced.sample.call(inputs)))]
    given: list[tuple[str, Sequence[Any], Sequence[Any]]] = []
    for name, function in traced.kernel.items():
        (values,) = function.call(inputs)
        given += [(name, [], [values]), (f"{name}_jacobian", [], [ca.jacobian(values, inputs[1]).T])]
    return given


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
    helpers = [helper for helper in helpers if not re.search(r"casadi_f(?:min|max)\(", helper.split("{")[0])]
    parts = [
        "#define casadi_real double",
        "#define casadi_int int",
        *[line for line in constants if line.startswith("static")],
        _EXTREMES,
        *[helper if helper.startswith("static") else f"static inline {helper}" for helper in helpers],
        *[_lean(body) for body in bodies],
        *[f"#define {public} {inner}" for public, inner in names],
    ]
    return "\n\n".join(parts)


def _lean(body: str) -> str:
    """CasADi's function without the tests for absent arguments and results: the runtime passes them all."""
    body = re.sub(r"^static int", "static inline int", body, flags=re.M)
    body = re.sub(r"arg\[(\d+)\]\? (arg\[\1\]\[\d+\]) : 0", r"\2", body)
    return re.sub(r"if \(res\[(\d+)\]!=0\) (res\[\1\])", r"\2", body)


def _wrapper(name: str, arguments: Sequence[str], results: Sequence[str]) -> str:
    """The function that the runtime calls by name, around the one that CasADi wrote over arrays of pointers."""
    timed = arguments[:1] == ("t",)
    pointers = arguments[1:] if timed else arguments
    declared = [*(["double t"] if timed else []), *(f"const double *{argument}" for argument in pointers)]
    passed = [*(["&t"] if timed else []), *pointers]
    unused = "".join(f"(void){name}; " for name in (*arguments, *results))
    return (
        f"static inline void model_{name}({', '.join(declared)}, {', '.join(f'double *{r}' for r in results)}) {{\n"
        f"    const double *arg[] = {{{', '.join(passed)}}};\n"
        f"    double *res[] = {{{', '.join(results)}}};\n"
        f"    {unused}\n"
        f"    traced_{name}(arg, res, 0, 0, 0);\n"
        f"}}"
    )


_WRAPPED: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "constants": (("p",), ("c",)),
    "derivatives": (_ARGUMENTS, ("dx",)),
    "outputs": (_ARGUMENTS, ("y",)),
    "indicators": (_ARGUMENTS, ("z",)),
    "indicator_rates": (_ARGUMENTS, ("dz",)),
    "jacobian": (_ARGUMENTS, ("jx", "jt")),
    "transition": ((*_ARGUMENTS, "above"), ("xn", "mn")),
    "sample": (_ARGUMENTS, ("xn", "mn")),
    "forward": ((*_ARGUMENTS, "sx", "su", "sp"), ("sdx", "sy")),
    "reverse": ((*_ARGUMENTS, "ldx", "ly"), ("lx", "lu", "lp")),
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
    defines.append(f"#define NC {functions[0].size1_out(0)}")
    sampled = model.sample is not None
    defines += [f"#define SAMPLED {int(sampled)}", f"#define KERNEL {int(model.kernel is not None)}"]
    if sampled:
        names = [variable.name for variable in interface.variables]
        defines.append(f"#define SAMPLE_TIME {names.index(model.sample_time)}")
    wrapped = dict(_WRAPPED)
    if model.kernel is not None:
        del wrapped["sample"]
        for name in traced.kernel:
            wrapped |= {name: (_ARGUMENTS, ("values",)), f"{name}_jacobian": (_ARGUMENTS, ("jx",))}
    wrappers = [_wrapper(name, *wrapped[name]) for name in wrapped]
    nominals = [interface.variables[reference].nominal for reference in interface.block("X")]
    body = "\n\n".join(
        [
            "\n".join(defines),
            '#include "instance.h"',
            *_tables(interface.variables, nominals),
            _traced_code(functions),
            *wrappers,
            '#include "instance.c"\n#include "solve.c"',
            *([] if model.kernel is None else [model.kernel.source]),
            f'#include "fmi{fmi}.c"',
        ]
    )
    runtime = "".join(path.read_text() for path in sorted(RUNTIME.glob("*.[ch]")))
    found = token(body + runtime)
    comment = f"/* {model.name}: generated from its Python source; {model.description.replace('*/', '')} */"
    return f'{comment}\n#define MODEL_TOKEN "{found}"\n{body}\n', found
