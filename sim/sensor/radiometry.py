"""From the sun to electrons, and from electrons to the signal-to-noise ratio.

A surface of radiance factor I/F under the solar photon irradiance E shows the radiance (I/F) E / pi. Behind a lens of
f-number N and transmission T a pixel of area A gathers on axis

    rate = (I/F) A T / (4 N^2)  integral of E(wavelength) T_filter(wavelength) QE(wavelength)      electrons per second

The sun is a black body of 5772 K and of its true size (IAU 2015 Resolution B3), at which it gives 1361 W/m2 at 1 AU.
Between 400 and 1100 nm that is within a few per cent of the measured spectrum, less than the quantum efficiency and
the lens are known to; what is left is in the calibrated transmission of the lens.

Calibrations
------------
The field-test paper (section III.B) gives dark current's share of the noise and the signal-to-noise ratio on the
darkest terrain at -34, 0 and +23 deg C. Two constants are set so that one model meets them together:
`LENS_TRANSMISSION` (signal) and `DARK_E_S` (dark current). A share is read as 1 - SNR / SNR without dark current, and
the ratio as the mean over the picture's rows, which wait for their readout for different times. From 0 to 23 deg C dark
current that doubles every 6 deg C grows 14.3 times, while the paper's shares ask for 9.1 times; the constant lies
between, so that both shares are missed alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from marsyard.sim.sensor.detector import dark_seconds
from marsyard.sim.sensor.parameters import DetectorParameters

_PLANCK, _LIGHT, _BOLTZMANN = 6.62607015e-34, 2.99792458e8, 1.380649e-23
_SUN_K, _SUN_RADIUS_M, _AU_M = 5772.0, 6.957e8, 1.495978707e11

#: Calibrated: signal for an SNR of 103 without dark current at `DARKEST_RADIANCE_FACTOR`; window and losses included.
LENS_TRANSMISSION = 0.519
#: Calibrated: dark current of a 12 um pixel at 0 deg C, electrons per second (0.018 nA/cm2).
DARK_E_S = 159.0
#: Radiance factor of the darkest terrain: albedo 0.1 under an afternoon sun.
DARKEST_RADIANCE_FACTOR = 0.07
#: Optical density of reflection at the two surfaces of a plate of index 1.51.
REFLECTION_DENSITY = -2.0 * float(np.log10(1.0 - (0.51 / 2.51) ** 2))
#: Assumed: neutral glass grows clearer towards the infrared, by this share of its density per 100 nm. With it filters
#: of the paper's densities transmit the paper's 22 % and 11 % (a flat density would give 21.4 % and 10.7 %).
DENSITY_SLOPE_PER_100_NM = -0.085

#: Assumed: quantum efficiency of a front-illuminated silicon CCD.
_QE_NM = np.arange(400.0, 1101.0, 50.0)
_QE = np.array([15.0, 22.0, 28.0, 33.0, 38.0, 42.0, 43.0, 40.0, 34.0, 27.0, 19.0, 11.0, 5.0, 2.0, 0.0]) / 100.0


#: What an exposure is set for where it is not known: a radiance factor of 0.3 fills 60 % of the full well.
BRIGHT_RADIANCE_FACTOR, BRIGHT_SHARE = 0.3, 0.6


def bright_exposure_s(full_well_e: float, responsivity_e_s: float) -> float:
    """The exposure time at which a bright surface fills most of the full well."""
    return BRIGHT_SHARE * full_well_e / (BRIGHT_RADIANCE_FACTOR * responsivity_e_s)


@dataclass(frozen=True)
class NeutralDensity:
    """A neutral-density filter.

    Attributes
    ----------
    glass
        Name of the glass.
    thickness_mm
        Thickness.
    density_per_mm
        Optical density of a millimetre of glass, weighted by what the detector sees of the sun.
    """

    glass: str
    thickness_mm: float
    density_per_mm: float

    @property
    def optical_density(self) -> float:
        """Spectrally weighted optical density with the reflection at both surfaces."""
        return REFLECTION_DENSITY + self.density_per_mm * self.thickness_mm


#: The paper's filters (III.B.2); densities per millimetre are calibrated to its optical densities 0.67 and 0.97.
NG4_FLIGHT = NeutralDensity("NG4", 1.44, (0.67 - REFLECTION_DENSITY) / 1.44)
NG3_FIELD = NeutralDensity("NG3", 1.35, (0.97 - REFLECTION_DENSITY) / 1.35)


@dataclass(frozen=True)
class LightPath:
    """What lies between the sun and a pixel's electrons.

    Attributes
    ----------
    f_number, pixel_pitch_um
        Of the lens; of the detector, micrometres.
    band_nm
        First and last wavelength of the passband.
    neutral_density
        Filter in front of the lens, or None.
    transmission
        Of the lens.
    quantum_efficiency
        Wavelengths, nm, and electrons per photon there, straight between them and none beyond; None for that of a
        front-illuminated silicon CCD.
    """

    f_number: float
    pixel_pitch_um: float
    band_nm: tuple[float, float]
    neutral_density: NeutralDensity | None = None
    transmission: float = LENS_TRANSMISSION
    quantum_efficiency: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def responsivity_e_s(self, sun_distance_au: float) -> float:
        """Electrons per second in a pixel on axis that looks at radiance factor 1."""
        wavelength_nm, electrons = self._electrons_per_m2()
        passed = electrons * self._filter(wavelength_nm, electrons)
        area = (self.pixel_pitch_um * 1e-6) ** 2
        flux = float(np.trapezoid(passed, wavelength_nm)) / sun_distance_au**2
        return area * self.transmission * flux / (4.0 * self.f_number**2)

    def mean_wavelength_nm(self) -> float:
        """Mean wavelength of the electrons' photons."""
        wavelength_nm, electrons = self._electrons_per_m2()
        return float(np.average(wavelength_nm, weights=electrons * self._filter(wavelength_nm, electrons)))

    def diffraction_px(self) -> float:
        """Mean wavelength times f-number over the pixel pitch."""
        return 1e-3 * self.mean_wavelength_nm() * self.f_number / self.pixel_pitch_um

    def _electrons_per_m2(self) -> tuple[Float64[np.ndarray, "n"], Float64[np.ndarray, "n"]]:
        """Wavelengths, and electrons per second, m2 and nm at 1 AU behind neither lens nor filter."""
        wavelength_nm = np.linspace(*self.band_nm, 281)
        if self.quantum_efficiency is None:
            efficiency = np.interp(wavelength_nm, _QE_NM, _QE)
        else:
            efficiency = np.interp(wavelength_nm, *self.quantum_efficiency, left=0.0, right=0.0)
        return wavelength_nm, solar_photons(wavelength_nm) * efficiency

    def _filter(
        self, wavelength_nm: Float64[np.ndarray, "n"], weights: Float64[np.ndarray, "n"]
    ) -> Float64[np.ndarray, "n"]:
        if self.neutral_density is None:
            return np.ones_like(wavelength_nm)
        middle = np.average(wavelength_nm, weights=weights)
        tilt = 1.0 + DENSITY_SLOPE_PER_100_NM * (wavelength_nm - middle) / 100.0
        return np.asarray(10.0 ** (-self.neutral_density.optical_density * tilt))


def solar_photons(wavelength_nm: Float64[np.ndarray, "n"]) -> Float64[np.ndarray, "n"]:
    """Photons of sunlight per second, m2 and nm at 1 AU."""
    wavelength = wavelength_nm * 1e-9
    occupation = 1.0 / np.expm1(_PLANCK * _LIGHT / (wavelength * _BOLTZMANN * _SUN_K))
    photons: Float64[np.ndarray, "n"] = 2.0 * np.pi * _LIGHT / wavelength**4 * occupation
    return photons * (_SUN_RADIUS_M / _AU_M) ** 2 * 1e-9


def signal_to_noise(
    parameters: DetectorParameters, radiance_factor: float, rows: int = 1024
) -> Float64[np.ndarray, "delivered_rows"]:
    """Signal over noise of each delivered row on axis, without smear and without the pixels' unequal response.

    Noise is that of the signal's and the dark current's electrons, of reading and of rounding to counts.
    """
    p = parameters
    signal = radiance_factor * p.responsivity_e_s * p.exposure_s * p.rows_summed
    dark = p.rows_summed * p.dark_e_s * p.dark_growth * dark_seconds(p, rows)
    noise = np.sqrt(signal + dark + p.read_noise_e**2 + p.gain_e_dn**2 / 12.0)
    return np.asarray(signal / noise)
