"""Camera optics: point spread and stray light, natural fall-off, and dust on the camera window."""

from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float32
from pydantic import Field
from scipy.special import j1

from marsyard.sim.camera import Cahvore, CameraModel
from marsyard.sim.error_sources import OPTICS
from marsyard.sim.parameters import NonNegative, Parameters

#: Half size of the point spread kernel, pixels. Its truncation makes the transfer of the presets at most 0.01 too high
#: (0.02 with 8 pixels, 0.005 with 32), at the Nyquist frequency.
KERNEL_HALF_SIZE_PX = 16
_FREQUENCIES = 513  #: Number of frequencies, up to the Nyquist frequency, of the modulation transfer function.
Image = Float32[np.ndarray, "rows columns"]
#: Factor q of the field angle in the projected pupil area of a fisheye, cos(q theta): from a MER front hazcam, the sky
#: of Opportunity image 1F483288473EFFCMUFP1214L0M1, 60 to 85 deg off axis (not flat-fielded; accuracy 10 %).
PUPIL_FRACTION = 0.95


class OpticsParameters(Parameters):
    """Point spread and dust. Defaults: an f/12 lens at 700 nm on 12 um pixels, without dust."""

    diffraction_px: Annotated[NonNegative, Field(le=5.0, description="wavelength x f-number / pitch; 0: none")] = 0.70
    diffusion_px: Annotated[NonNegative, Field(le=5.0, description="RMS charge diffusion, px (assumed)")] = 0.25
    pixel_aperture: Annotated[bool, Field(description="average over pixels; only for point-sampled scenes")] = False
    defocus_px: Annotated[
        NonNegative, OPTICS, Field(le=10.0, description="defocus: diameter of the blur circle of a point")
    ] = 0.0
    stray_light: Annotated[
        float, OPTICS, Field(ge=0.0, le=0.5, description="stray light: fraction of all light that is spread evenly")
    ] = 0.0
    dust_discs: Annotated[
        int, OPTICS, Field(ge=0, le=1000, description="number of specks of dust on the camera window")
    ] = 0
    dust_depth: Annotated[float, Field(ge=0.0, le=1.0, description="fraction of the light absorbed by a speck")] = 0.3
    dust_radius_px: Annotated[float, Field(gt=0.0, le=1000.0, description="mean shadow radius, px; +- 1/3")] = 25.0
    dust_softness: Annotated[float, Field(gt=0.0, le=1.0, description="half width of the edge / radius")] = 0.5


@lru_cache(maxsize=32)
def line_spread(parameters: OpticsParameters) -> Float32[np.ndarray, "taps"]:
    """Compute the line spread function: weights of the neighbouring pixels along a row or column, with sum 1.

    The Fourier series of the weights is the modulation transfer function up to the Nyquist frequency, truncated to
    `KERNEL_HALF_SIZE_PX`. It is the product of the functions of a diffraction-limited circular pupil,
    2/pi (acos s - s sqrt(1 - s^2)) with s = frequency x wavelength x f-number (Goodman, Introduction to Fourier
    Optics, 6.4), of diffusion, exp(-2 (pi sigma f)^2), of defocus, 2 J1(x) / x with x = pi d f for a uniform disc of
    diameter d, and optionally of the pixel aperture, sinc(f). Rows and columns are treated as separable, which is an
    approximation for a round pupil.
    """
    frequency = np.linspace(0.0, 0.5, _FREQUENCIES)
    transfer = np.exp(-2.0 * (np.pi * parameters.diffusion_px * frequency) ** 2)
    if parameters.pixel_aperture:
        transfer = transfer * np.sinc(frequency)
    if parameters.defocus_px > 0.0:
        x = np.maximum(np.pi * parameters.defocus_px * frequency, 1e-9)
        transfer = transfer * 2.0 * j1(x) / x
    s = np.minimum(frequency * parameters.diffraction_px, 1.0)
    transfer = transfer * (2.0 / np.pi) * (np.arccos(s) - s * np.sqrt(1.0 - s * s))
    offsets = np.arange(-KERNEL_HALF_SIZE_PX, KERNEL_HALF_SIZE_PX + 1)
    waves = np.cos(2.0 * np.pi * frequency[:, None] * offsets)
    taps = 2.0 * np.trapezoid(transfer[:, None] * waves, frequency, axis=0)
    weights: Float32[np.ndarray, "taps"] = (taps / taps.sum()).astype(np.float32)
    weights.setflags(write=False)
    return weights


def apply_point_spread(radiance: Image, parameters: OpticsParameters) -> Image:
    """Blur a scene by lens and charge diffusion, without loss or shift; the scene is mirrored at the border.

    Stray light replaces a fraction of the radiance of every pixel by the same fraction of the scene's mean radiance.
    """
    p, scene = parameters, radiance
    if p.diffraction_px > 0.0 or p.diffusion_px > 0.0 or p.defocus_px > 0.0 or p.pixel_aperture:
        taps = line_spread(p)
        scene = np.asarray(cv2.sepFilter2D(radiance, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT))
    if p.stray_light > 0.0:
        scene = np.float32(1.0 - p.stray_light) * scene + np.float32(p.stray_light * scene.mean(dtype=np.float64))
    return scene


def natural_fall_off(camera: CameraModel) -> Image:
    """Compute the relative brightness of each pixel behind an unvignetted lens, 1 at the brightest.

    The brightness is proportional to the pixel's solid angle dOmega and to the projected area of the entrance pupil:
    ``dOmega cos(q theta)`` with the angle theta from the optical axis. For a fixed pupil q is 1; for a perspective lens
    the product is then the fourth power of the cosine. The pupil of a fisheye (CAHVORE) tilts towards the ray (Kumler &
    Bauer 2000, Proc. SPIE 4093), so that the image is not dark at 90 deg; q is `PUPIL_FRACTION`.
    """
    _origins, directions = camera.rays(camera.pixel_grid())
    down, right = np.gradient(directions, axis=(0, 1), edge_order=2)
    solid_angle = np.linalg.norm(np.cross(down, right), axis=-1)
    axis, fraction = (camera.o, PUPIL_FRACTION) if isinstance(camera, Cahvore) else (camera.a, 1.0)
    off_axis = np.arccos(np.clip(directions @ (axis / np.linalg.norm(axis)), -1.0, 1.0))
    brightness = solid_angle * np.clip(np.cos(fraction * off_axis), 0.0, None)
    # a pixel outside the camera's field of view has no ray; its brightness is zero
    return np.asarray(np.nan_to_num(brightness / np.nanmax(brightness)).astype(np.float32))


def dust_transmission(shape: tuple[int, int], parameters: OpticsParameters, rng: np.random.Generator) -> Image:
    """Draw the transmission of dust on the camera window: absorbing discs with soft edges at random positions."""
    transmission = np.ones(shape, dtype=np.float32)
    for _ in range(parameters.dust_discs):
        centre = rng.uniform(0.0, 1.0, 2) * shape
        radius = parameters.dust_radius_px * rng.uniform(2.0 / 3.0, 4.0 / 3.0)
        outer_px = radius * (1.0 + parameters.dust_softness)
        first = np.maximum(centre - outer_px, 0.0).astype(int)
        last = np.minimum(centre + outer_px + 1.0, shape).astype(int)
        row, column = np.ogrid[first[0] : last[0], first[1] : last[1]]
        distance = np.hypot(row - centre[0], column - centre[1]) / radius
        coverage = np.clip((1.0 + parameters.dust_softness - distance) / (2.0 * parameters.dust_softness), 0.0, 1.0)
        # smooth step from the edge to the centre
        shade = 1.0 - parameters.dust_depth * coverage**2 * (3.0 - 2.0 * coverage)
        transmission[first[0] : last[0], first[1] : last[1]] *= shade.astype(np.float32)
    return transmission
