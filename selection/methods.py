"""The methods of selection by name, for those who only ask for one: what they are made of takes long to import."""

from __future__ import annotations

from typing import Literal, get_args

# By the observability index, see `selection.observability`, and by the error of the best filter: the semidefinite
# program of `selection.h2`, and the optimum of `selection.optimal`.
ByIndex = Literal["structural", "coupled", "exact", "numerical"]
ByError = Literal["h2", "optimal"]
Method = Literal["structural", "coupled", "exact", "numerical", "h2", "optimal"]
METHODS: tuple[ByIndex, ...] = get_args(ByIndex)
BY_ERROR: tuple[ByError, ...] = get_args(ByError)
# What states are scaled by before the semidefinite program is solved.
Scaling = Literal["deviation", "nominal"]
