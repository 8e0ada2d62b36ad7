"""Rows of the validation page, with the conditions in which each was checked (`validation.json`).

`python -m benchmarks.validation` writes the file from the stored measurements, so that reports also have the rows
where only the package is installed.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter

from marsyard.campaigns.json_numbers import Number

VALIDATION_FILE = Path(__file__).with_name("validation.json")
Range = tuple[float, float]


@dataclass(frozen=True)
class Conditions:
    """Conditions in which rows were checked; a quantity that is None was not varied and has no effect on the row.

    - rows: pattern of the claims of these rows
    - systems: systems whose verdicts the rows concern; None for all
    - data: key of the flight or test data that the rows are compared with; empty for an independent calculation
    - site, camera: sites of the terrain (also a rendered DTM), and camera presets
    - sun_elevation_deg: elevation of the sun above the horizon
    - slope_deg: RMS slope of the terrain over its slope baseline
    - optical_depth: optical depth of the atmosphere
    - range_m: distance to the ground or to the target; altitude of a descent
    """

    rows: str = "*"
    systems: tuple[str, ...] | None = None
    data: str = ""
    site: tuple[str, ...] | None = None
    camera: tuple[str, ...] | None = None
    sun_elevation_deg: Range | None = None
    slope_deg: Range | None = None
    optical_depth: Range | None = None
    range_m: Range | None = None

    @property
    def quantities(self) -> dict[str, tuple[str, ...] | Range]:
        """Names or ranges of the quantities that are not None."""
        values = {name: getattr(self, name) for name in QUANTITIES}
        return {name: value for name, value in values.items() if value is not None}

    @property
    def text(self) -> str:
        """The conditions in words."""
        return "; ".join(f"{QUANTITIES[name]} {format_range(value)}" for name, value in self.quantities.items())


#: Quantities of the conditions, with their names in texts.
QUANTITIES: Mapping[str, str] = {
    "site": "site",
    "camera": "camera",
    "sun_elevation_deg": "sun elevation (deg)",
    "slope_deg": "RMS slope (deg)",
    "optical_depth": "optical depth",
    "range_m": "range (m)",
}


class RowKind(StrEnum):
    """What a row compares the simulation with."""

    VERIFICATION = "verification"  #: an independent calculation
    VALIDATION = "validation"  #: flight or test data to which no constant was fitted
    FIT = "fit"  #: data to which constants were fitted


@dataclass(frozen=True)
class ValidationRow:
    """A row of the validation page: claim, limit and measured value, as in `benchmarks.validation.records.Measure`."""

    claim: str
    measured: Number
    unit: str
    limit: float | None
    sense: Literal["at most", "at least"]
    how: str
    conditions: Conditions
    kind: RowKind = RowKind.VERIFICATION

    @property
    def is_met(self) -> bool | None:
        """Whether the limit is met; None without a limit."""
        if self.limit is None:
            return None
        # NaN meets no limit
        return self.measured <= self.limit if self.sense == "at most" else self.measured >= self.limit

    def concerns(self, system: str) -> bool:
        """Whether the row concerns the verdicts of a system."""
        return self.conditions.systems is None or system in self.conditions.systems

    @property
    def text(self) -> str:
        """Claim, measured value and limit."""
        unit = f" {self.unit}" if self.unit not in ("", "1") else ""
        limit = "" if self.limit is None else f", limit {self.sense} {self.limit:.3g}{unit}"
        return f"{self.claim}: {self.measured:.3g}{unit}{limit}"


@dataclass(frozen=True)
class ValidationCheck:
    """Rows of a check, its section of the page, and the machine and versions of its last run."""

    section: str
    environment: Mapping[str, str]
    rows: tuple[ValidationRow, ...]


_ADAPTER = TypeAdapter(dict[str, ValidationCheck])


def read_checks(path: Path = VALIDATION_FILE) -> Mapping[str, ValidationCheck]:
    """Read the rows by check. Raises ValueError if the file is invalid, OSError if it cannot be read."""
    return _ADAPTER.validate_json(path.read_bytes())


@cache
def rows_of_system(system: str) -> list[ValidationRow]:
    """List the packaged rows that concern the verdicts of a system."""
    return [row for check in read_checks().values() for row in check.rows if row.concerns(system)]


def format_range(value: tuple[str, ...] | Range) -> str:
    """Format names or a range; `1.4 to 2`."""
    if all(isinstance(item, str) for item in value):
        return ", ".join(map(str, value))
    low, high = value
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def to_json(checks: Mapping[str, ValidationCheck]) -> bytes:
    """Convert checks to the content of the packaged file."""
    return _ADAPTER.dump_json(dict(checks), indent=1, exclude_defaults=True) + b"\n"


def merge_ranges(values: Collection[tuple[str, ...] | Range]) -> tuple[Any, ...] | None:
    """Merge names to their union, and ranges to the smallest range that contains all; None for no value."""
    if not values:
        return None
    items = [item for value in values for item in value]
    if isinstance(items[0], str):
        return tuple(dict.fromkeys(items))
    return min(items), max(items)
