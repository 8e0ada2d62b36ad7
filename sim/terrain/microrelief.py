"""Relief finer than a terrain's samples: its spectrum continued to a millimetre, as octaves of height noise."""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Float64
from scipy.special import gamma, kv

#: Waves of the coarsest octave per Nyquist wave of the samples, and size of the finest lattice cells, metres.
_FIRST_WAVE, FINEST_M = 1.0, 0.001
#: Waves per lattice cell of the noise, in the median of its power, and its mean square.
WAVES_PER_CELL, NOISE_VARIANCE = 0.61, 0.0464


@cache
def octave_heights(
    hurst: float, slope_rad: float, baseline_m: float, outer_scale_m: float, spacing_m: float
) -> tuple[float, Float64[np.ndarray, "octaves"]]:
    """Cell size of the coarsest octave, metres, and the amplitude of each octave of height noise, metres.

    The ground's power spectral density is ``(k**2 + k0**2)**-(H + 1)`` (`landforms.ground.Spectrum`), whose correlation
    is Matérn's; its slope over the baseline gives its variance. An octave around the wavenumber k has the fraction
    ``(1 + (k1 / k0)**2)**-H - (1 + (k2 / k0)**2)**-H`` of it, k1 and k2 a factor sqrt(2) below and above k.
    """
    k0 = 2.0 * np.pi / outer_scale_m
    lag = k0 * baseline_m
    correlation = 2.0 ** (1.0 - hurst) / gamma(hurst) * lag**hurst * kv(hurst, lag)
    variance = (np.tan(slope_rad) * baseline_m) ** 2 / (2.0 * (1.0 - correlation))
    coarsest = WAVES_PER_CELL * 2.0 * spacing_m / _FIRST_WAVE
    octaves = max(int(np.log2(coarsest / FINEST_M)) + 1, 0)
    middle = 2.0 * np.pi * WAVES_PER_CELL / (coarsest * 0.5 ** np.arange(octaves))
    below, above = ((1.0 + (middle * factor / k0) ** 2) ** -hurst for factor in (np.sqrt(0.5), np.sqrt(2.0)))
    heights = np.sqrt(variance * (below - above) / NOISE_VARIANCE)
    heights.setflags(write=False)
    return coarsest, heights
