"""Tests of detectors from datasheets, against manual calculation and the presets."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.sim.sensor import DetectorChoice, DetectorParameters, preset, read_datasheet

CHOICE: TypeAdapter[DetectorParameters] = TypeAdapter(DetectorChoice)
#: Sony IMX265: rounded EMVA 1288 values from a camera manufacturer, with a 16 mm f/4 lens.
DATASHEET = """name = "Sony IMX265, f/4"
pixel_pitch_um = 3.45
full_well_e = 10500
read_noise_e = 2.4
bits = 12
quantum_efficiency = 0.65
dark_current_e_s = 1.0
dark_temperature_c = 20.0
prnu = 0.005
rows = 1536
readout_s = 0.0512

[lens]
f_number = 4.0
band_nm = [420.0, 680.0]
transmission = 0.9
"""


def write_datasheet(folder: Path, text: str = DATASHEET) -> Path:
    path = folder / "sensor.toml"
    path.write_text(text)
    return path


def test_parameters_follow_from_the_datasheet(tmp_path: Path) -> None:
    detector = read_datasheet(write_datasheet(tmp_path)).parameters()
    assert detector.gain_e_dn == pytest.approx(10500 / 4096)
    assert detector.rows_summed == 1
    assert detector.transfer_row_s == detector.clear_row_s == 0.0
    assert detector.readout_row_s == pytest.approx(0.0512 / 1536)
    # At its specified temperature the dark current is that of the datasheet.
    assert detector.temperature_c == 20.0
    assert detector.dark_e_s * detector.dark_growth == pytest.approx(1.0)
    # The diffraction is the mean wavelength, 0.55 um, times the f-number, divided by the pixel pitch.
    assert detector.optics.diffraction_px == pytest.approx(0.55 * 4 / 3.45, rel=0.02)
    # A radiance factor of 0.3 fills 60 % of the full well.
    assert 0.3 * detector.responsivity_e_s * detector.exposure_s == pytest.approx(0.6 * 10500)


def test_responsivity_counts_solar_photons(tmp_path: Path) -> None:
    """The solar irradiance is 475 W/m2 between 420 and 680 nm (ASTM E490). The mean photon energy is that of 550 nm."""
    detector = read_datasheet(write_datasheet(tmp_path, "sun_au = 1.0\n" + DATASHEET)).parameters()
    photons_m2_s = 475.0 / (6.62607015e-34 * 2.99792458e8 / 550e-9)
    expected = 0.65 * 0.9 * (3.45e-6) ** 2 * photons_m2_s / (4.0 * 4.0**2)
    # The sun is modelled as a black body, whose irradiance is up to 9 % below ASTM E490 in green light.
    assert detector.responsivity_e_s == pytest.approx(expected, rel=0.1)
    # `sunlight` is the solar irradiance at `sun_au`, relative to 1 au.
    assert detector.sunlight == 1.0
    distant_detector = read_datasheet(write_datasheet(tmp_path, "sun_au = 3.0\n" + DATASHEET)).parameters()
    assert distant_detector.responsivity_e_s / distant_detector.sunlight == pytest.approx(detector.responsivity_e_s)


def test_constant_efficiency_curve_equals_scalar_efficiency(tmp_path: Path) -> None:
    curve = DATASHEET.replace("quantum_efficiency = 0.65\n", "").replace(
        "[lens]", "[quantum_efficiency]\nwavelength_nm = [300.0, 900.0]\nefficiency = [0.65, 0.65]\n\n[lens]"
    )
    parameters = read_datasheet(write_datasheet(tmp_path)).parameters()
    assert read_datasheet(write_datasheet(tmp_path, curve)).parameters() == parameters


def test_mer_ccd_from_datasheet_matches_the_preset(tmp_path: Path) -> None:
    """Values of Maki et al. 2003 and the assumed quantum efficiency curve reproduce the preset's detector."""
    efficiency_percent = [15, 22, 28, 33, 38, 42, 43, 40, 34, 27, 19, 11, 5, 2, 0]
    text = f"""pixel_pitch_um = 12.0
full_well_e = 170000
read_noise_e = 25
bits = 12
gain_e_dn = 41.5
black_level_dn = 20
dark_current_e_s = 159
dark_temperature_c = 0
temperature_c = -40
shutter = "frame-transfer"
transfer_row_s = 5e-6
rows = 1024
readout_s = 5.4272
[quantum_efficiency]
wavelength_nm = {[400.0 + 50.0 * k for k in range(15)]}
efficiency = {[percent / 100 for percent in efficiency_percent]}
[lens]
f_number = 12.0
band_nm = [600.0, 800.0]
"""
    actual = read_datasheet(write_datasheet(tmp_path, text)).parameters()
    expected = preset("mer-navcam").detector
    for name in ("responsivity_e_s", "exposure_s", "full_well_e", "gain_e_dn", "read_noise_e", "readout_row_s"):
        assert getattr(actual, name) == pytest.approx(getattr(expected, name), rel=1e-3), name
    assert actual.dark_e_s * actual.dark_growth == pytest.approx(expected.dark_e_s * expected.dark_growth)


def test_datasheet_replaces_the_detector_of_a_preset(tmp_path: Path) -> None:
    path = write_datasheet(tmp_path)
    detector = LandingScenarioParameters.model_validate({"detector": {"file": str(path), "bits": 9}}).detector
    assert detector == read_datasheet(path).parameters().model_copy(update={"file": str(path), "bits": 9})


def test_stored_parameters_do_not_need_the_datasheet_file(tmp_path: Path) -> None:
    path = write_datasheet(tmp_path)
    parameters = CHOICE.validate_python(str(path))
    assert parameters == read_datasheet(path).parameters().model_copy(update={"file": str(path)})
    # Stored parameters are validated without reading the datasheet file again.
    path.write_text("")
    assert CHOICE.validate_python(parameters.model_dump(mode="json")) == parameters
    path.write_text(DATASHEET)
    custom = CHOICE.validate_python({"file": str(path), "temperature_c": -10.0, "optics": {"dust_discs": 3}})
    assert (custom.temperature_c, custom.optics.dust_discs) == (-10.0, 3)
    assert custom.full_well_e == parameters.full_well_e
    # The stored values suffice after the file is deleted.
    stored_values = custom.model_dump(mode="json")
    path.unlink()
    assert CHOICE.validate_python(stored_values) == custom
    assert CHOICE.validate_python("xc-55") == preset("xc-55").detector
    assert np.isfinite(custom.dark_growth)


FAULTS = [
    ("full_well_e = 10500\n", "", "sensor.toml: full_well_e: Field required"),
    ("full_well_e = 10500", "full_well = 10500", "sensor.toml: full_well_e: Field required"),
    ("full_well_e = 10500", "full_well_e = -1", "full_well_e: Input should be greater than 0"),
    ("bits = 12", "bits = 24", "bits: Input should be less than or equal to 16"),
    ("bits = 12", 'bits = 12\nshutter = "rolling"', "shutter: Input should be 'global' or 'frame-transfer'"),
    ("bits = 12", 'bits = 12\nshutter = "frame-transfer"', "must be above 0"),
    ("[420.0, 680.0]", "[680.0, 420.0]", "two increasing wavelengths"),
    ("bits = 12", "bits = = 12", "not valid TOML"),
]


@pytest.mark.parametrize(("old", "new", "fault"), FAULTS, ids=[new or "nothing" for _, new, _ in FAULTS])
def test_datasheet_errors_are_reported(tmp_path: Path, old: str, new: str, fault: str) -> None:
    assert old in DATASHEET
    path = write_datasheet(tmp_path, DATASHEET.replace(old, new))
    with pytest.raises(ValidationError, match=fault) as error_info:
        CHOICE.validate_python(str(path))
    assert "sensor.toml" in str(error_info.value)


def test_preset_and_file_together_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="not both"):
        CHOICE.validate_python({"file": str(write_datasheet(tmp_path)), "preset": "xc-55"})
    with pytest.raises(ValidationError, match="cannot be read"):
        CHOICE.validate_python("absent.toml")
