"""Tests of the register of fitted constants."""

from dataclasses import replace

import pytest

from marsyard.reports.fits import Constant, fit_note, fitted_data, read_register


@pytest.mark.parametrize("constant", read_register(), ids=lambda constant: constant.where)
def test_constant_exists_with_the_registered_value(constant: Constant) -> None:
    assert constant.value_in_force() == constant.value


def test_places_that_do_not_exist_are_errors() -> None:
    constant = read_register()[0]
    for where in ("sim/terrain/sites.toml:sites.gusev.unknown", "marsyard.sim.sensor.detector:DetectorParameters.x"):
        with pytest.raises(LookupError):
            replace(constant, where=where).value_in_force()


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
        "LENS_TRANSMISSION", "DARK_E_S", "_FLIGHT_RESIDUAL", "residual_px", "crater_sand_log_albedo",
        "crater_ejecta_contrast", "relief_log_albedo", "crest_length", "regularity", "cover", "wind_east_m_s",
        "change_k", "averaging_after_s",
    }  # fmt: skip
    assert "spirit-descent" in fitted_data()
