"""The methods of `selection.observability` by name, for those who only ask for one: it takes long to import."""

from __future__ import annotations

from typing import Literal

Method = Literal["structural", "coupled", "exact", "numerical"]
METHODS: tuple[Method, ...] = ("structural", "coupled", "exact", "numerical")
