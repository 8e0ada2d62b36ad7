"""A case as stored: one row, with the columns that the engine writes around the scenario's own."""

from __future__ import annotations

from collections.abc import Mapping

from marsyard.scenarios.interface import Scalar

#: One case as stored.
Row = Mapping[str, Scalar]

#: Columns that the engine writes, before and behind those of the scenario.
LEADING_COLUMNS = ("case", "outcome", "answered")
TRAILING_COLUMNS = ("wall_time_s", "cpu_time_s", "error", "traceback")
