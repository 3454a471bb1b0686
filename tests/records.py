"""Records made by hand and what a metric gives on them, for the tests of the metrics."""

import numpy as np

from fmus.component import Signal
from harness.definitions import Definition, Measured, measure
from harness.record import Record

TIME = np.arange(0, 1001) * 1e-3  # s


def record(columns, time=None, crank=None):
    """A record of columns named `part.signal` with (values, unit) or (values, unit, kind); of TIME where none given."""
    signals = tuple(
        Signal(name, column[1], kind=column[2] if len(column) > 2 else "real") for name, column in columns.items()
    )
    rows = TIME if time is None else np.asarray(time, dtype=float)
    return Record(signals, rows, np.column_stack([column[0] for column in columns.values()]).astype(float), crank=crank)


def on_crank(columns, crank, seconds_a_degree=1 / 6000.0):
    """A record on a crank clock, at a constant speed; crank (n,) [deg]."""
    crank = np.asarray(crank, dtype=float)
    return record(columns, (crank - crank[0]) * seconds_a_degree, crank)


def measured(definition, recorded, experiment="") -> Measured:
    """What the metric `m` of that definition gives of a record, or of the columns of one over TIME."""
    rows = record(recorded) if isinstance(recorded, dict) else recorded
    return measure({"m": Definition.model_validate(definition)}, rows, experiment)


def values_of(definition, recorded):
    """Its values without units: {suffix: value}."""
    found = measured(definition, recorded).values
    return {name.removeprefix("m").removeprefix("."): value.value for name, value in found.items()}
