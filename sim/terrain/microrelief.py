"""Relief finer than a terrain's samples: its spectrum is extended to 1 mm by octaves of height noise."""

from functools import cache

import numpy as np
from jaxtyping import Float64
from scipy.special import gamma, kv

#: Frequency of the coarsest octave divided by the Nyquist frequency of the samples; size of the finest cells, metres.
_FIRST_FREQUENCY, FINEST_M = 1.0, 0.001
#: Properties of the noise kernel: median frequency of its power, cycles per lattice cell, and its mean square.
WAVES_PER_CELL, NOISE_VARIANCE = 0.61, 0.0464


@cache
def octave_heights(
    hurst: float, slope_rad: float, baseline_m: float, outer_scale_m: float, spacing_m: float
) -> tuple[float, Float64[np.ndarray, "octaves"]]:
    """Compute the cell size of the coarsest octave and the amplitude of each octave of height noise, metres.

    The ground's power spectral density is ``(k**2 + k0**2)**-(H + 1)`` (`landforms.ground.Spectrum`) with the Hurst
    exponent H and the wavenumber k0 of the outer scale. Its correlation function c is Matérn's. Its variance follows
    from the slope over the baseline L: ``(tan(slope) L)**2 = 2 variance (1 - c(L))``. An octave from k1 = k / sqrt(2)
    to k2 = k sqrt(2) around the wavenumber k has the fraction ``(1 + (k1 / k0)**2)**-H - (1 + (k2 / k0)**2)**-H`` of
    this variance.
    """
    k0 = 2.0 * np.pi / outer_scale_m
    scaled_lag = k0 * baseline_m
    correlation = 2.0 ** (1.0 - hurst) / gamma(hurst) * scaled_lag**hurst * kv(hurst, scaled_lag)
    variance = (np.tan(slope_rad) * baseline_m) ** 2 / (2.0 * (1.0 - correlation))
    coarsest = WAVES_PER_CELL * 2.0 * spacing_m / _FIRST_FREQUENCY
    octaves = max(int(np.log2(coarsest / FINEST_M)) + 1, 0)
    wavenumber = 2.0 * np.pi * WAVES_PER_CELL / (coarsest * 0.5 ** np.arange(octaves))
    fraction_above_k1, fraction_above_k2 = (
        (1.0 + (wavenumber * factor / k0) ** 2) ** -hurst for factor in (np.sqrt(0.5), np.sqrt(2.0))
    )
    heights = np.sqrt(variance * (fraction_above_k1 - fraction_above_k2) / NOISE_VARIANCE)
    heights.setflags(write=False)
    return coarsest, heights
