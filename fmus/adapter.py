"""The tables that adapter.c steps an FMU by: which variables travel in which call, in which units, and the log."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Container, Mapping, Sequence
from ctypes import POINTER, addressof, c_char, c_double, c_int, c_size_t, c_uint32, c_void_p, cast, sizeof
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

from fmus.component import ERROR, Native
from fmus.toolchain import compile_shared
from fmus.variable import Variable

_LOG_FIRST, _LOG_LAST = 64, 192


class Passage(NamedTuple):
    """How values of one FMI type pass: the name in the Set and Get functions, adapter.c's number for it, the C type."""

    function: str
    number: int
    c_type: Any


# By major version of FMI and type.
PASSAGES: Mapping[int, Mapping[str, Passage]] = {
    1: {
        "Real": Passage("Real", 0, c_double),
        "Integer": Passage("Integer", 6, c_int),
        "Enumeration": Passage("Integer", 6, c_int),
        "Boolean": Passage("Boolean", 3, ctypes.c_uint8),
        "String": Passage("String", -1, ctypes.c_char_p),
    },
    2: {
        "Real": Passage("Real", 0, c_double),
        "Integer": Passage("Integer", 6, c_int),
        "Enumeration": Passage("Integer", 6, c_int),
        "Boolean": Passage("Boolean", 11, c_int),
        "String": Passage("String", -1, ctypes.c_char_p),
    },
    3: {
        "Float64": Passage("Float64", 0, c_double),
        "Float32": Passage("Float32", 1, ctypes.c_float),
        "Int8": Passage("Int8", 2, ctypes.c_int8),
        "UInt8": Passage("UInt8", 3, ctypes.c_uint8),
        "Int16": Passage("Int16", 4, ctypes.c_int16),
        "UInt16": Passage("UInt16", 5, ctypes.c_uint16),
        "Int32": Passage("Int32", 6, ctypes.c_int32),
        "UInt32": Passage("UInt32", 7, ctypes.c_uint32),
        "Int64": Passage("Int64", 8, ctypes.c_int64),
        "UInt64": Passage("UInt64", 9, ctypes.c_uint64),
        "Enumeration": Passage("Int64", 8, ctypes.c_int64),
        "Boolean": Passage("Boolean", 10, ctypes.c_bool),
        "String": Passage("String", -1, ctypes.c_char_p),
    },
}


# A variable and the place of its first scalar on the bus.
Place = tuple[Variable, int]


class Message(NamedTuple):
    """One message of an FMU: the communication point it came at [s], its FMI status, its category and text."""

    time: float
    status: int
    category: str
    text: str


class _Entry(ctypes.Structure):
    _fields_ = (("time", c_double), ("status", c_int), ("category", c_char * 64), ("message", c_char * 1024))


class _Log(ctypes.Structure):
    _fields_ = (("count", c_size_t), ("entries", _Entry * (_LOG_FIRST + _LOG_LAST)))


class Conversion(ctypes.Structure):
    """The struct Conversion of adapter.c."""

    _fields_ = (("position", c_size_t), ("factor", c_double), ("offset", c_double))


class _Block(ctypes.Structure):
    _fields_ = (
        ("access", c_void_p),
        ("references", c_void_p),
        ("n_references", c_size_t),
        ("n_values", c_size_t),
        ("first", c_size_t),
        ("buffer", c_void_p),
        ("scratch", c_void_p),
        ("conversions", c_void_p),
        ("conversions_end", c_void_p),
        ("positions", c_void_p),
        ("type", c_int),
    )


class _Table(ctypes.Structure):
    _fields_ = (
        ("instance", c_void_p),
        ("failed", c_int),
        ("stage", c_int),
        ("time", c_double),
        ("inputs", c_void_p),
        ("inputs_end", c_void_p),
        ("do_step", c_void_p),
        ("outputs", c_void_p),
        ("outputs_end", c_void_p),
        ("log", POINTER(_Log)),
        ("held", c_void_p),
        ("held_end", c_void_p),
        ("real_status", c_void_p),
        ("boolean_status", c_void_p),
        ("terminated", c_int),
        ("last_successful_time", c_double),
        ("wired", c_void_p),
        ("wired_end", c_void_p),
        ("reversible", c_int),
    )


@cache
def stepping_library() -> ctypes.CDLL:
    """What steps FMUs, in one unit: adapter.c, and what goes with it for FMI 1, Model Exchange and taking back."""
    sources = ("adapter.c", "fmi1.c", "clocks.c", "exchange.c", "reversal.c")
    unit = "\n".join(files("fmus").joinpath(source).read_text(encoding="utf-8") for source in sources)
    library = ctypes.CDLL(str(compile_shared(unit)))
    for version in (1, 2, 3):
        step, write, read = (getattr(library, f"fmi{version}_{name}") for name in ("step", "write", "read"))
        step.argtypes = (c_void_p, c_double, c_double, c_void_p, c_void_p)
        write.argtypes = read.argtypes = (c_void_p, c_void_p)
    return library


def address(function: Any) -> int:
    """The address of a C function known to ctypes."""
    return cast(function, c_void_p).value or 0


def callback(name: str) -> int:
    """The address of a callback for FMUs: fmi1_log, fmi2_log, fmi3_log, fmi2_allocate, fmi2_free."""
    return address(getattr(stepping_library(), name))


class FmuNative(Native):
    """The step of an FMU; `reading(places)` is the same step where u is all of a bus, inputs at these places."""

    reading: Callable[[Sequence[int]], Native]


class Adapter:
    """The C side of one FMU: what a step touches, where its instance stands, and what the FMU said.

    `function` gives the address of a function of the FMU's library by its name without the prefix, like `DoStep`.
    `carried` are the inputs that steps set, `fetched` the outputs that they get.
    """

    def __init__(self, version: int, function: Callable[[str], int], kind: str = "cs") -> None:
        self._version, self._function = version, function
        self._log = _Log()
        self._table = _Table(log=ctypes.pointer(self._log), failed=ERROR)
        if kind == "cs":
            self._table.do_step = function("DoStep")
        if kind == "cs" and version < 3:
            self._table.real_status = function("GetRealStatus")
        if kind == "cs" and version == 2:
            self._table.boolean_status = function("GetBooleanStatus")
        self._memory: dict[str, list[Any]] = {}
        self.carried: list[Place] = []
        self.fetched: list[Place] = []
        self._readable = kind == "cs" and version > 1
        self.self = addressof(self._table)
        self.step = getattr(stepping_library(), f"fmi{version}_step")
        self.write = getattr(stepping_library(), f"fmi{version}_write")
        self.read = getattr(stepping_library(), f"fmi{version}_read")

    def native(self) -> Native:
        """The step and the table it works on; both addresses stay the same over all starts."""
        if not self._readable:
            return Native(address(self.step), self.self)
        native = FmuNative(address(self.step), self.self)
        native.reading = self._reading
        return native

    def _reading(self, places: Sequence[int]) -> Native:
        """The step that takes its inputs from these places of a bus, in one pass without a copy before."""
        self._enter("wired", "Set", self.carried, places)
        return Native(address(getattr(stepping_library(), f"fmi{self._version}_step_wired")), self.self)

    @property
    def table(self) -> Any:
        """The instance, how it ended and where: fields of the struct Slave in adapter.c."""
        return self._table

    def carry(self, inputs: Sequence[Variable], held: Container[str] = ()) -> None:
        """Let each step set these variables from the bus, in this order; those named in `held` at the start only.

        An array takes a place for each scalar.
        """
        places = _places(inputs)
        self.carried = [place for place in places if place[0].name not in held]
        self._enter("inputs", "Set", self.carried)
        self._enter("held", "Set", [place for place in places if place[0].name in held])

    def fetch(self, outputs: Sequence[Variable]) -> None:
        """Let each step get these variables to the bus, in this order, and no others."""
        self.fetched = _places(outputs)
        self._enter("outputs", "Get", self.fetched)

    def renew(self, t0: float) -> None:
        """Forget what the last instance said and where it stopped."""
        self._log.count, self._table.time = 0, t0
        self._table.terminated, self._table.last_successful_time = 0, math.nan

    def log(self) -> list[Message]:
        """The messages since the last start, oldest first: all, or the first 64 and the last 192."""
        count = self._log.count
        kept = [*range(min(count, _LOG_FIRST)), *range(max(_LOG_FIRST, count - _LOG_LAST), count)]
        entries = [self._log.entries[n if n < _LOG_FIRST else _LOG_FIRST + (n - _LOG_FIRST) % _LOG_LAST] for n in kept]
        return [
            Message(e.time, e.status, e.category.decode(errors="replace"), e.message.decode(errors="replace").rstrip())
            for e in entries
        ]

    def dropped(self) -> int:
        """How many messages since the last start are not in the log."""
        return max(0, int(self._log.count) - _LOG_FIRST - _LOG_LAST)

    def _enter(self, name: str, access: str, places: Sequence[Place], at: Sequence[int] = ()) -> None:
        """One block for each way of passing among the variables, in the order in which they first come.

        `at` gives the places on the bus of the scalars where those are not 0, 1, ... in order.
        """
        groups: dict[Passage, list[Place]] = {}
        for place in places:
            groups.setdefault(PASSAGES[self._version][place[0].type], []).append(place)
        memory: list[Any] = []
        made = [self._block(group, access, passage, memory, at) for passage, group in groups.items()]
        blocks = (_Block * len(made))(*made)
        memory.append(blocks)
        self._memory[name] = memory
        begin = addressof(blocks)
        setattr(self._table, name, begin)
        setattr(self._table, f"{name}_end", begin + sizeof(blocks))

    def _block(self, group: list[Place], access: str, passage: Passage, memory: list[Any], at: Sequence[int]) -> _Block:
        def hold(array: Any) -> int:
            memory.append(array)
            return addressof(array)

        positions = [first + i for variable, first in group for i in range(variable.size)]
        positions = [at[position] for position in positions] if at else positions
        scales = [scale(variable) for variable, _ in group for _ in range(variable.size)]
        n = len(positions)
        setting, converts = access == "Set", any(scale != (1.0, 0.0) for scale in scales)
        double = passage.c_type is c_double
        in_row = positions == list(range(positions[0], positions[0] + n))
        in_place = double and in_row and not (setting and converts)
        whole = setting and not in_place
        conversions = [
            Conversion(p, *scale) for p, scale in zip(positions, scales, strict=True) if whole or scale != (1.0, 0.0)
        ]
        buffer = None if in_place else hold((passage.c_type * n)())
        begin = hold((Conversion * len(conversions))(*conversions))
        return _Block(
            access=self._function(access + passage.function),
            references=hold((c_uint32 * len(group))(*(variable.reference for variable, _ in group))),
            n_references=len(group),
            n_values=n,
            first=positions[0],
            buffer=buffer,
            scratch=buffer if double else hold((c_double * n)()),
            conversions=begin,
            conversions_end=begin + len(conversions) * sizeof(Conversion),
            positions=hold((c_size_t * n)(*positions)),
            type=passage.number,
        )


def scale(variable: Variable) -> tuple[float, float]:
    """Factor and offset of the unit a variable is declared in: (1, 0) for SI units and for what has none."""
    quantity = variable.quantity
    return (1.0, 0.0) if quantity is None else (quantity.factor, quantity.offset)


def _places(variables: Sequence[Variable]) -> list[Place]:
    places, position = [], 0
    for variable in variables:
        if variable.size:
            places.append((variable, position))
        position += variable.size
    return places
