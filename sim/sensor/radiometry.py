"""Camera radiometry: electrons of a pixel from the sunlight that a surface reflects.

A surface with radiance factor I/F under the solar photon irradiance E has the radiance (I/F) E / pi. Behind a lens with
f-number N and transmission T, a pixel of area A on the optical axis collects electrons per second at the rate
``(I/F) A T / (4 N^2)  integral of E(wavelength) T_filter(wavelength) QE(wavelength)``.

The sun is a black body of 5772 K with its nominal radius (IAU 2015 Resolution B3): 1361 W/m2 at 1 AU. Between 400 and
1100 nm the difference from the measured spectrum is a few per cent, less than the uncertainty of quantum efficiency and
lens transmission. The calibrated transmission of the lens compensates for the difference.

Calibration: the field-test paper (section III.B) reports the signal-to-noise ratio (SNR) on the darkest terrain, and
the fraction of the noise due to dark current, at -34, 0 and +23 deg C. Two constants are fitted: `LENS_TRANSMISSION`
(signal) and `DARK_E_S` (dark current). The fraction is 1 - SNR / (SNR without dark current), averaged over the image
rows, which have different readout delays. From 0 to 23 deg C a dark current that doubles every 6 deg C grows by a
factor of 14.3, but the fraction in the paper by 9.1. `DARK_E_S` is chosen such that both fractions have equal errors.

The field-test paper is Johnson et al., "Field Testing of the MER DIMES".
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

#: Planck constant, speed of light and Boltzmann constant, SI units.
_PLANCK, _SPEED_OF_LIGHT, _BOLTZMANN = 6.62607015e-34, 2.99792458e8, 1.380649e-23
#: Temperature and radius of the sun, and the astronomical unit.
_SUN_K, _SUN_RADIUS_M, _AU_M = 5772.0, 6.957e8, 1.495978707e11
#: Calibrated for an SNR of 103 without dark current at `DARKEST_RADIANCE_FACTOR`; includes window and other losses.
LENS_TRANSMISSION = 0.519
DARK_E_S = 159.0  #: Calibrated: dark current of a 12 um pixel at 0 deg C, electrons per second (0.018 nA/cm2).
DARKEST_RADIANCE_FACTOR = 0.07  #: Radiance factor of the darkest terrain: albedo 0.1 under an afternoon sun.
#: Optical densities of the paper's filters (III.B.2), weighted by the detector's solar response, with reflection at
#: both surfaces: 1.44 mm of NG4 in flight, 1.35 mm of NG3 in the field test.
NG4_FLIGHT, NG3_FIELD = 0.67, 0.97
#: Assumed: relative change of a neutral glass' density per 100 nm. The filters then have the
#: transmissions in the paper, 22 % and 11 % (21.4 % and 10.7 % with a constant density).
DENSITY_SLOPE_PER_100_NM = -0.085
#: Assumed: quantum efficiency of a front-illuminated silicon CCD.
_QE_NM = np.arange(400.0, 1101.0, 50.0)
_QE = np.array([15.0, 22.0, 28.0, 33.0, 38.0, 42.0, 43.0, 40.0, 34.0, 27.0, 19.0, 11.0, 5.0, 2.0, 0.0]) / 100.0
#: Exposure of cameras without a given exposure time: at the radiance factor 0.3 a pixel collects 60 % of the full well.
BRIGHT_RADIANCE_FACTOR, BRIGHT_FILL = 0.3, 0.6
_WAVELENGTHS = 281  #: Number of wavelengths over a passband: every 2.5 nm from 400 to 1100 nm.
Spectrum = Float64[np.ndarray, "n"]  #: One value per wavelength.


def bright_exposure_s(full_well_e: float, responsivity_e_s: float) -> float:
    """Compute the default exposure time from `BRIGHT_FILL` and `BRIGHT_RADIANCE_FACTOR`, s."""
    return BRIGHT_FILL * full_well_e / (BRIGHT_RADIANCE_FACTOR * responsivity_e_s)


@dataclass(frozen=True)
class LightPath:
    """Parameters of the light path from the sun to the electrons of a pixel.

    - band_nm: first and last wavelength of the passband
    - neutral_density: optical density of the filter in front of the lens, or None
    - transmission: transmission of the lens
    - quantum_efficiency: wavelengths, nm, and electrons per photon, interpolated linearly, zero outside; None for a
      front-illuminated silicon CCD
    """

    f_number: float
    pixel_pitch_um: float
    band_nm: tuple[float, float]
    neutral_density: float | None = None
    transmission: float = LENS_TRANSMISSION
    quantum_efficiency: tuple[tuple[float, ...], tuple[float, ...]] | None = None

    def responsivity_e_s(self, sun_distance_au: float) -> float:
        """Compute the electrons per second in a pixel on axis at radiance factor 1."""
        wavelength_nm, electrons = self._filtered_electrons()
        area = (self.pixel_pitch_um * 1e-6) ** 2
        flux = float(np.trapezoid(electrons, wavelength_nm)) / sun_distance_au**2
        return area * self.transmission * flux / (4.0 * self.f_number**2)

    def diffraction_px(self) -> float:
        """Compute the diffraction scale in pixels: mean wavelength of detected photons x f-number / pixel pitch."""
        wavelength_nm, electrons = self._filtered_electrons()
        return 1e-3 * float(np.average(wavelength_nm, weights=electrons)) * self.f_number / self.pixel_pitch_um

    def _filtered_electrons(self) -> tuple[Spectrum, Spectrum]:
        """Return wavelengths, and electrons per second, m2 and nm behind the filter without the lens at 1 AU."""
        wavelength_nm = np.linspace(*self.band_nm, _WAVELENGTHS)
        if self.quantum_efficiency is None:
            efficiency = np.interp(wavelength_nm, _QE_NM, _QE)
        else:
            efficiency = np.interp(wavelength_nm, *self.quantum_efficiency, left=0.0, right=0.0)
        electrons = solar_photons(wavelength_nm) * efficiency
        if self.neutral_density is None:
            return wavelength_nm, electrons
        mean_nm = np.average(wavelength_nm, weights=electrons)
        relative_density = 1.0 + DENSITY_SLOPE_PER_100_NM * (wavelength_nm - mean_nm) / 100.0
        return wavelength_nm, electrons * 10.0 ** (-self.neutral_density * relative_density)


def solar_photons(wavelength_nm: Spectrum) -> Spectrum:
    """Compute the photons of sunlight per second, m2 and nm at 1 AU."""
    wavelength = wavelength_nm * 1e-9
    occupation = 1.0 / np.expm1(_PLANCK * _SPEED_OF_LIGHT / (wavelength * _BOLTZMANN * _SUN_K))
    photons: Spectrum = 2.0 * np.pi * _SPEED_OF_LIGHT / wavelength**4 * occupation
    return photons * (_SUN_RADIUS_M / _AU_M) ** 2 * 1e-9
