"""Register of the constants that were fitted to data (`fitted.toml`): a comparison with the same data is a fit."""

import tomllib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

REGISTER = Path(__file__).with_name("fitted.toml")


@dataclass(frozen=True)
class FittedData:
    """Data to which constants were fitted: key, title, and source."""

    key: str
    title: str
    source: str


@dataclass(frozen=True)
class Constant:
    """A constant that was fitted to data.

    - where: ``FILE.toml:path`` relative to the package, or ``module:NAME``, also with fields of a class
    - value: its value
    - data: the data to which it was fitted
    - quantity: quantity of the data that was made to agree
    - seeds: seeds of the simulated cases that were used
    - systems, sites: systems whose results depend on it; sites of these campaigns, empty for all
    """

    where: str
    value: float
    data: FittedData
    quantity: str
    seeds: str
    systems: tuple[str, ...]
    sites: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Last part of `where`: the name of the parameter, constant or field."""
        return self.where.rpartition(":")[2].rpartition(".")[2]

    def concerns(self, system: str, sites: Collection[str]) -> bool:
        """Whether the results of a system over these sites depend on it."""
        return system in self.systems and (not self.sites or not set(self.sites).isdisjoint(sites))


@cache
def read_register() -> tuple[Constant, ...]:
    """Read the packaged register."""
    return read_constants(REGISTER)


def read_constants(path: Path) -> tuple[Constant, ...]:
    """Read a register. Raises OSError or ValueError if it cannot be read."""
    return tuple(_read_constants(tomllib.loads(path.read_text(encoding="utf-8"))))


def _read_constants(content: Mapping[str, Any]) -> Iterator[Constant]:
    data = {key: FittedData(key, **values) for key, values in content["data"].items()}
    for fit in content["fits"]:
        systems, sites = tuple(fit["systems"]), tuple(fit.get("sites", ()))
        for where, value in fit["constants"].items():
            yield Constant(where, value, data[fit["data"]], fit["quantity"], fit["seeds"], systems, sites)


def fitted_data() -> frozenset[str]:
    """Return the keys of all data to which a constant was fitted."""
    return frozenset(constant.data.key for constant in read_register())


def fit_note(data: str) -> str:
    """Explain that a comparison with these data is a fit, with the fitted constants. Raises KeyError for other data."""
    names = dict.fromkeys(constant.name for constant in read_register() if constant.data.key == data)
    if not names:
        raise KeyError(data)
    return f"Fit, not validation: fitted to these data are {', '.join(names)} (`fitted.toml`)."
