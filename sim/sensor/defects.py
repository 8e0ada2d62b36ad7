"""What goes wrong in a detector and its cable: hot and dead pixels, and the list that hides them; bursts of noise."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float32, UInt16
from pydantic import Field
from scipy.ndimage import uniform_filter

from marsyard.sim.parameters import Fraction, NonNegative, Parameters


class DefectParameters(Parameters):
    """Pixels that do not work as the others. None by default."""

    hot_share: Annotated[Fraction, Field(description="share of hot pixels")] = 0.0
    hot_e_s: Annotated[
        NonNegative, Field(description="mean dark current of a hot pixel at 0 deg C, electrons per second")
    ] = 20000.0
    dead_share: Annotated[Fraction, Field(description="share of pixels without response")] = 0.0
    listed: Annotated[
        bool, Field(description="whether the camera has a list of them all, and fills them from their neighbours")
    ] = False


class BurstParameters(Parameters):
    """Bursts of noise on the cable while the picture is read out. None by default."""

    bursts: Annotated[NonNegative, Field(le=1e4, description="mean number of bursts in a picture")] = 0.0
    length_px: Annotated[float, Field(gt=0.0, le=1e7, description="mean length of a burst, delivered pixels")] = 2000.0
    amplitude_dn: Annotated[NonNegative, Field(description="RMS of the noise in a burst, counts")] = 300.0


def dead_pixels(
    shape: tuple[int, int], parameters: DefectParameters, rng: np.random.Generator
) -> Bool[np.ndarray, "rows columns"]:
    """Which pixels do not respond."""
    return rng.random(shape, dtype=np.float32) < parameters.dead_share


def hot_currents(
    shape: tuple[int, int], parameters: DefectParameters, rng: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Dark current at 0 deg C in excess of the others', electrons per second; exponentially distributed if hot."""
    hot = rng.random(shape, dtype=np.float32) < parameters.hot_share
    current = np.zeros(shape, dtype=np.float32)
    current[hot] = parameters.hot_e_s * rng.standard_exponential(int(hot.sum()), dtype=np.float32)
    return current


def filled(
    counts: UInt16[np.ndarray, "rows columns"], bad: Bool[np.ndarray, "rows columns"]
) -> UInt16[np.ndarray, "rows columns"]:
    """Counts with the bad pixels replaced by the mean of those of their eight neighbours that are good, if any are."""
    good = np.where(bad, 0.0, 1.0)
    total, share = (uniform_filter(values, 3, mode="constant") for values in (good * counts, good))
    # means of nine: where there is one good neighbour the share is 1/9
    known = bad & (share > 0.5 / 9.0)
    repaired = counts.copy()
    repaired[known] = np.rint(total[known] / share[known]).astype(np.uint16)
    return repaired


def add_bursts(
    counts: Float32[np.ndarray, "rows columns"], parameters: BurstParameters, rng: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Counts with bursts of noise: each begins anywhere and lasts along the rows as they are read out."""
    if parameters.bursts == 0.0:
        return counts
    disturbed = counts.reshape(-1).copy()
    for _ in range(int(rng.poisson(parameters.bursts))):
        start = int(rng.integers(disturbed.size))
        struck = disturbed[start : start + 1 + int(rng.exponential(parameters.length_px))]
        struck += np.float32(parameters.amplitude_dn) * rng.standard_normal(struck.size, dtype=np.float32)
    return disturbed.reshape(counts.shape)
