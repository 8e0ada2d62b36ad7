"""Between the scene and the pixels: point spread, fall-off and dust on the lens."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float32, Float64
from pydantic import Field

from marsyard.sim.camera import Cahvore, CameraModel
from marsyard.sim.parameters import NonNegative, Parameters

#: Half size of the point spread's kernel, pixels.
REACH_PX = 6
#: Share of the field angle by which a fisheye's pupil is foreshortened: a MER front hazcam's, measured on the sky of
#: Opportunity's picture 1F483288473EFFCMUFP1214L0M1 from 60 to 85 deg off axis (not flat-fielded; to 10 %).
PUPIL_SHARE = 0.95


class OpticsParameters(Parameters):
    """Point spread and dust. The defaults are an f/12 lens at 700 nm on 12 um pixels, without dust."""

    diffraction_px: Annotated[
        NonNegative, Field(le=5.0, description="wavelength times f-number over pixel pitch; 0 for no diffraction")
    ] = 0.70
    diffusion_px: Annotated[
        NonNegative, Field(le=5.0, description="RMS spread of charge by diffusion, pixels; the default is assumed")
    ] = 0.25
    pixel_aperture: Annotated[
        bool, Field(description="average over the pixel's area; not for pictures rendered at a pixel's footprint")
    ] = False
    dust_discs: Annotated[int, Field(ge=0, le=1000, description="specks of dust on the lens")] = 0
    dust_depth: Annotated[float, Field(ge=0.0, le=1.0, description="share of the light that a speck absorbs")] = 0.3
    dust_radius_px: Annotated[
        float, Field(gt=0.0, le=1000.0, description="mean radius of a speck's shadow, pixels; each differs by a third")
    ] = 25.0
    dust_softness: Annotated[
        float, Field(gt=0.0, le=1.0, description="half width of a shadow's edge over its radius: it is out of focus")
    ] = 0.5


@lru_cache(maxsize=32)
def line_spread(parameters: OpticsParameters) -> Float32[np.ndarray, "taps"]:
    """Weights of a pixel's neighbours along a row or column; their sum is 1.

    The weights are those whose Fourier series is the modulation transfer up to the Nyquist frequency: that of a
    diffraction-limited circular pupil, 2/pi (acos s - s sqrt(1 - s^2)) with s = frequency x wavelength x f-number
    (Goodman, Introduction to Fourier Optics, 6.4), times that of diffusion, exp(-2 (pi sigma f)^2), and of the pixel's
    aperture, sinc(f), where asked for. Rows and columns are treated apart, which replaces the round pupil by one
    whose transfer is the product of both sections.
    """
    frequency = np.linspace(0.0, 0.5, 513)
    transfer = np.exp(-2.0 * (np.pi * parameters.diffusion_px * frequency) ** 2)
    if parameters.pixel_aperture:
        transfer = transfer * np.sinc(frequency)
    s = np.minimum(frequency * parameters.diffraction_px, 1.0)
    transfer = transfer * (2.0 / np.pi) * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    offsets = np.arange(-REACH_PX, REACH_PX + 1)
    waves = np.cos(2.0 * np.pi * frequency[:, None] * offsets)
    taps = 2.0 * np.trapezoid(transfer[:, None] * waves, frequency, axis=0)
    weights: Float32[np.ndarray, "taps"] = (taps / taps.sum()).astype(np.float32)
    weights.setflags(write=False)
    return weights


def spread(
    radiance: Float32[np.ndarray, "rows columns"], parameters: OpticsParameters
) -> Float32[np.ndarray, "rows columns"]:
    """The picture that the lens and the diffusion of charge make of a scene; light is neither lost nor shifted.

    At the frame's border the scene is taken to continue as its mirror image.
    """
    if parameters.diffraction_px == 0.0 and parameters.diffusion_px == 0.0 and not parameters.pixel_aperture:
        return radiance
    taps = line_spread(parameters)
    return np.asarray(cv2.sepFilter2D(radiance, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT))


def natural_fall_off(camera: CameraModel) -> Float32[np.ndarray, "rows columns"]:
    """Brightness of each pixel behind an unvignetted lens, 1 at the brightest.

    A pixel gathers light in proportion to the solid angle it sees and to the area of the entrance pupil as seen along
    its ray: ``dOmega cos(q theta)``, theta the angle from the lens's axis. Where the pupil stands still, q is 1: for a
    perspective lens the product is the fourth power of the cosine. A fisheye's pupil, whose motion CAHVORE describes,
    turns a little towards the ray (Kumler & Bauer 2000, Proc. SPIE 4093), and its picture keeps light at 90 deg. For it
    q is `PUPIL_SHARE`.
    """
    _origins, directions = camera.rays(camera.pixel_grid())
    down = np.gradient(directions, axis=0, edge_order=2)
    right = np.gradient(directions, axis=1, edge_order=2)
    solid_angle = np.linalg.norm(np.cross(down, right), axis=-1)
    axis, share = (camera.o, PUPIL_SHARE) if isinstance(camera, Cahvore) else (camera.a, 1.0)
    off_axis = np.arccos(np.clip(directions @ (axis / np.linalg.norm(axis)), -1.0, 1.0))
    pupil = np.clip(np.cos(share * off_axis), 0.0, None)
    brightness: Float64[np.ndarray, "rows columns"] = solid_angle * pupil
    # pixels that no ray reaches are dark
    fall_off = np.nan_to_num(brightness / np.nanmax(brightness)).astype(np.float32)
    return np.asarray(fall_off)


def dust_transmission(
    shape: tuple[int, int], parameters: OpticsParameters, rng: np.random.Generator
) -> Float32[np.ndarray, "rows columns"]:
    """Share of the light that passes the dust: soft absorbing discs at random places."""
    rows, columns = shape
    transmission = np.ones(shape, dtype=np.float32)
    row, column = np.arange(rows)[:, None], np.arange(columns)[None, :]
    for _ in range(parameters.dust_discs):
        middle = rng.uniform(0.0, 1.0, 2) * (rows, columns)
        radius = parameters.dust_radius_px * rng.uniform(2.0 / 3.0, 4.0 / 3.0)
        distance = np.hypot(row - middle[0], column - middle[1]) / radius
        inside = np.clip((1.0 + parameters.dust_softness - distance) / (2.0 * parameters.dust_softness), 0.0, 1.0)
        transmission *= (1.0 - parameters.dust_depth * inside**2 * (3.0 - 2.0 * inside)).astype(np.float32)
    return transmission
