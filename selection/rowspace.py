"""Exact row spaces modulo a Mersenne prime, in C: which states the rows of sets of sensors determine, and when."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from ctypes import c_int, c_size_t, c_void_p
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fmus.toolchain import compile_shared

Residues = NDArray[np.uint64]
Indices = NDArray[np.int64]
Sets = Sequence[tuple[int, ...]]
Told = Callable[[int], None]

Flags = NDArray[np.bool_]

# Sets between two calls of `tell`, and the powers of A that are made at first; twice as many where those do not do.
_CHUNK = 2048
_FIRST_STEPS = 8


@dataclass(frozen=True)
class Field:
    """The integers modulo 2^bits - 1, a prime for bits 31 and 61; residues are uint64 in 0 ... 2^bits - 2."""

    bits: int = 61

    def __post_init__(self) -> None:
        if self.bits not in (31, 61):
            raise ValueError(f"bits wants 31 or 61, got {self.bits}")

    @property
    def prime(self) -> int:
        """2^bits - 1."""
        return (1 << self.bits) - 1

    def residues(self, values: object) -> Residues:
        """An array of Python integers of any size and sign as residues."""
        array = np.asarray(values, dtype=object)
        return np.array([int(v) % self.prime for v in array.ravel()], dtype=np.uint64).reshape(array.shape)

    def random(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Residues:
        """Residues drawn evenly from all but zero."""
        return rng.integers(1, self.prime, shape, dtype=np.uint64)


@dataclass(frozen=True)
class Rows:
    """A system modulo a prime: A (n, n), the sensors' gradients (s, n), how many differentiations late each is (s,)."""

    A: Residues
    sensors: Residues
    lags: NDArray[np.int64]


@cache
def _library() -> ctypes.CDLL:
    """The compiled C. Raises ConfigurationError: there is no compiler."""
    library = ctypes.CDLL(str(compile_shared(files("selection").joinpath("rowspace.c").read_text("utf-8"))))
    library.selection_powers.argtypes = (c_int, *(c_size_t,) * 3, *(c_void_p,) * 3)
    library.selection_indices.argtypes = (c_int, *(c_size_t,) * 2, *(c_void_p,) * 2, *(c_size_t,) * 2, *(c_void_p,) * 5)
    library.selection_powers.restype = library.selection_indices.restype = None
    return library


def spanned_units(rows: Rows, sets: Sets, field: Field, tell: Told = lambda done: None, threads: int = 1) -> Indices:
    """The least rho at which the rows c A^k, k < rho - lag, of each set's sensors span each unit vector.

    Shape (sets, n); 0 where they never do. `sets` hold places of sensors; `tell` hears how many more sets are done.
    """
    n = len(rows.A)
    lags = np.ascontiguousarray(rows.lags, dtype=np.int64)
    found = np.zeros((len(sets), n), dtype=np.int64)
    left, steps = np.arange(len(sets)), min(_FIRST_STEPS, n)
    with ThreadPoolExecutor(threads) as pool:
        while len(left):
            powers = _powers(rows, field, steps)

            def work(chunk: Chunk, powers: Residues = powers) -> Flags:
                here, done = _indices(powers, lags, chunk.members, field)
                found[chunk.places] = here
                return done

            waiting = list(_chunks(sets, left))
            unfinished = []
            for chunk, done in zip(waiting, pool.map(work, waiting), strict=True):
                unfinished.append(chunk.places[~done])
                tell(int(done.sum()))
            left, steps = np.sort(np.concatenate(unfinished)), min(2 * steps, n)
    return found


def _indices(powers: Residues, lags: Indices, members: Indices, field: Field) -> tuple[Indices, Flags]:
    """The indices of sets of one size as far as the powers at hand tell, and whether they tell all."""
    steps, n = powers.shape[1:]
    memory, first = np.zeros(n * n + n, dtype=np.uint64), np.zeros(n, dtype=np.uintp)
    found, done = np.zeros((len(members), n), dtype=np.int64), np.zeros(len(members), dtype=np.uint8)
    arrays = (members.ctypes.data, memory.ctypes.data, first.ctypes.data, found.ctypes.data, done.ctypes.data)
    _library().selection_indices(
        field.bits, n, steps, powers.ctypes.data, lags.ctypes.data, len(members), members.shape[1], *arrays
    )
    return found, done.astype(bool)


def _powers(rows: Rows, field: Field, steps: int) -> Residues:
    """Rows c A^k of each sensor, k = 0 ... steps - 1; shape (sensors, steps, n)."""
    n, count = len(rows.A), len(rows.sensors)
    a, gradients = (np.ascontiguousarray(part, dtype=np.uint64) for part in (rows.A, rows.sensors))
    found = np.zeros((count, steps, n), dtype=np.uint64)
    arrays = (a.ctypes.data, gradients.ctypes.data, found.ctypes.data)
    _library().selection_powers(field.bits, n, count, steps, *arrays)
    return found


class Chunk(NamedTuple):
    """Sets of one size: their places among all, and their members, shape (chunk, size)."""

    places: Indices
    members: Indices


def _chunks(sets: Sets, among: Indices) -> Iterator[Chunk]:
    """The sets at these places, in chunks."""
    sizes = np.array([len(sets[place]) for place in among], dtype=np.int64)
    for size in np.unique(sizes):
        places = among[sizes == size]
        for begin in range(0, len(places), _CHUNK):
            chunk = places[begin : begin + _CHUNK]
            members = np.array([sets[place] for place in chunk], dtype=np.int64).reshape(len(chunk), int(size))
            yield Chunk(chunk, np.ascontiguousarray(members))
