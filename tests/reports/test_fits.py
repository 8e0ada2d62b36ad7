"""Tests of the register of fitted constants."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from marsyard.reports.fits import Constant, fit_note, fitted_data, read_register
from marsyard.reports.validation_rows import RowKind, read_checks
from marsyard.scenarios.imports import import_object

PACKAGE = Path(__file__).parents[2]


def _read_value_in_force(where: str) -> Any:
    """Read the value at the place of a constant from the code or the file."""
    source, _, path = where.partition(":")
    names = path.split(".")
    if source.endswith(".toml"):
        value: Any = tomllib.loads((PACKAGE / source).read_text(encoding="utf-8"))
    else:
        value = import_object(f"{source}:{names.pop(0)}")
    for name in names:
        if isinstance(value, type) and issubclass(value, BaseModel):
            value = value.model_fields[name].default
        else:
            value = value[int(name) if isinstance(value, list) else name]
    return value


@pytest.mark.parametrize("constant", read_register(), ids=lambda constant: constant.where)
def test_constant_exists_with_the_registered_value(constant: Constant) -> None:
    assert _read_value_in_force(constant.where) == constant.value


def test_constants_are_registered_once_with_known_systems() -> None:
    places = [constant.where for constant in read_register()]
    assert len(places) == len(set(places))
    assert {name for constant in read_register() for name in constant.systems} <= {
        "dimes", "fieldtest", "hda", "localisation", "vtt",
    }  # fmt: skip


def test_constant_concerns_only_its_sites() -> None:
    crest = next(item for item in read_register() if item.name == "crater_sand_log_albedo" and "gusev" in item.sites)
    assert crest.concerns("dimes", {"gusev"})
    assert not crest.concerns("dimes", {"pisgah"})
    assert not crest.concerns("vtt", {"gusev"})


def test_note_names_the_constants_of_the_data() -> None:
    assert "averaging_after_s" in fit_note("hda-table-2")
    with pytest.raises(KeyError):
        fit_note("unknown")


def test_values_called_calibrated_in_the_code_are_registered() -> None:
    # the constants that comments and pages call calibrated or fitted
    names = {constant.name for constant in read_register()}
    assert names >= {
        "LENS_TRANSMISSION", "DARK_E_S", "FLIGHT_RESIDUAL", "residual_px", "crater_sand_log_albedo",
        "crater_ejecta_contrast", "relief_log_albedo", "crest_length", "regularity", "cover", "wind_east_m_s",
        "change_k", "averaging_after_s",
    }  # fmt: skip
    assert "spirit-descent" in fitted_data()


def list_fitted_tables() -> Iterator[str]:
    """Yield ``FILE:TABLE`` of each table of the packaged TOML files with a comment on fitted values."""
    for path in sorted(path for folder in ("sim", "scenarios") for path in (PACKAGE / folder).rglob("*.toml")):
        lines, table = path.read_text(encoding="utf-8").splitlines(), ""
        for number, line in enumerate(lines):
            if line.startswith("["):
                table = line.strip("[] ")
            elif line.startswith("#") and re.search(r"\bfitted\b|calibrated to", line, re.IGNORECASE):
                following = next((item for item in lines[number:] if not item.startswith("#")), "")
                name = following.strip("[] ") if following.startswith("[") else table
                yield f"{path.relative_to(PACKAGE).as_posix()}:{name}"


def test_tables_with_fitted_values_are_registered() -> None:
    places = [constant.where for constant in read_register()]
    tables = [
        table
        for table in list_fitted_tables()
        if not table.split(":")[0].endswith(("variants.toml", "requirements.toml"))
    ]
    assert len(tables) >= 5
    assert [table for table in tables if not any(place.startswith(table.split("[")[0]) for place in places)] == []


def test_comparisons_with_data_of_fits_are_no_validation() -> None:
    """Data of validation rows are registered, or are those to which no constant was fitted."""
    rows = [row for check in read_checks().values() for row in check.rows if row.conditions.data]
    predicted = {"dimes-templates", "sky-images"}
    assert {row.conditions.data for row in rows} <= fitted_data() | predicted
    for row in rows:
        assert row.kind is (RowKind.VALIDATION if row.conditions.data in predicted else RowKind.FIT), row.claim
