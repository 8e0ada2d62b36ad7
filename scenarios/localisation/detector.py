"""Detector of the lander's camera."""

from __future__ import annotations

import numpy as np

from marsyard.scenarios.localisation.camera import LanderCameraParameters
from marsyard.sim.sensor import DetectorParameters
from marsyard.sim.sensor.optics import OpticsParameters
from marsyard.sim.sensor.radiometry import BRIGHT_FILL, BRIGHT_RADIANCE_FACTOR, LightPath

#: Distance of Mars from the sun at the landing on 2021-02-18: heliocentric longitude Ls = 5 deg on the orbit of Mars.
LANDING_AU = 1.57
#: Signal-to-noise ratio of a pixel of `LANDER_DETECTOR` at half of its full well.
HALF_WELL_SNR = 80.0
#: Noise of reading a summed pixel, electrons (assumed).
_READ_NOISE_E = 10.0
_EXPOSURE_S = 150e-6
_BITS = 8


def _full_well_e() -> float:
    """Solve S / sqrt(S + r^2 + q^2) = SNR for the full well 2 S; q is the error of rounding to counts of 2 S / 2^b.

    With q^2 = c S^2, c = (2 / 2^b)^2 / 12, this is (1 - c SNR^2) S^2 - SNR^2 S - SNR^2 r^2 = 0.
    """
    square = HALF_WELL_SNR**2
    quadratic = 1.0 - square * (2.0 / 2**_BITS) ** 2 / 12.0
    half = (square + np.sqrt(square**2 + 4.0 * quadratic * square * _READ_NOISE_E**2)) / (2.0 * quadratic)
    return float(2.0 * half)


def _create_detector() -> DetectorParameters:
    full_well = _full_well_e()
    # f-number, pixel pitch (um), passband (nm)
    light = LightPath(2.7, LanderCameraParameters().pixel_pitch_um, (400.0, 900.0))
    return DetectorParameters(
        exposure_s=_EXPOSURE_S,
        responsivity_e_s=BRIGHT_FILL * full_well / (BRIGHT_RADIANCE_FACTOR * _EXPOSURE_S),
        sun_au=LANDING_AU,
        rows_summed=1,
        transfer_row_s=0.0,
        clear_row_s=0.0,
        readout_row_s=1e-4,
        full_well_e=full_well,
        gain_e_dn=full_well / 2**_BITS,
        read_noise_e=_READ_NOISE_E,
        offset_dn=2.0,
        bits=_BITS,
        temperature_c=0.0,
        dark_e_s=2000.0,
        optics=OpticsParameters(diffraction_px=light.diffraction_px(), diffusion_px=0.25),
    )


#: Detector of the lander's camera: global shutter, 8 bits, 150 us, SNR 80 at half full well, f/2.7. Pixels are sums of
#: 2 x 2. Assumed: read noise, offset, dark current (0.3 electrons in an exposure), readout, passband, blur; and the
#: responsivity, which fills 60 % of the full well at the radiance factor 0.3 (the other presets' exposure). It is 35 %
#: of that of an f/2.7 lens on a CCD of the same pitch: the rest is lost in the fill factor of a global shutter.
LANDER_DETECTOR = _create_detector()
