"""Camera optics and radiometry: sunlight to electrons, point spread, natural fall-off, dust, and motion blur.

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

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
from jaxtyping import Float, Float32, Float64
from pydantic import Field
from scipy.spatial.transform import RigidTransform
from scipy.special import j1

from marsyard.sim.camera import Cahvore, CameraModel
from marsyard.sim.error_sources import OPTICS
from marsyard.sim.parameters import NonNegative, Parameters
from marsyard.sim.sensor.imu import Vector
from marsyard.sim.sensor.kernels import Transfer, add_smear, average_blocks, blur, cumulative_row_sums, gather_blocks

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
KERNEL_HALF_SIZE_PX = 6  #: Half size of the point spread kernel, pixels.
Image = Float32[np.ndarray, "rows columns"]
#: Factor q of the field angle in the projected pupil area of a fisheye, cos(q theta): from a MER front hazcam, the sky
#: of Opportunity image 1F483288473EFFCMUFP1214L0M1, 60 to 85 deg off axis (not flat-fielded; accuracy 10 %).
PUPIL_FRACTION = 0.95
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
        wavelength_nm = np.linspace(*self.band_nm, 281)
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

    The Fourier series of the weights is the modulation transfer function up to the Nyquist frequency. It is the product
    of the functions of a diffraction-limited circular pupil, 2/pi (acos s - s sqrt(1 - s^2)) with s = frequency x
    wavelength x f-number (Goodman, Introduction to Fourier Optics, 6.4), of diffusion, exp(-2 (pi sigma f)^2), of
    defocus, 2 J1(x) / x with x = pi d f for a uniform disc of diameter d, and optionally of the pixel aperture,
    sinc(f). Rows and columns are treated as separable, which is an approximation for a round pupil.
    """
    frequency = np.linspace(0.0, 0.5, 513)
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


GRID_STEP_PX = 32.0  #: Spacing of the velocity grid's nodes, pixels.
SKY_DISTANCE_M = 1e9  #: Distance assumed for pixels without range (the sky), metres.
STILL_PX = 0.01  #: Maximum motion of an image that is treated as still, pixels.
#: Maximum motion during the transfer of a block of rows, pixels, and minimum and maximum number of rows in a block.
BLOCK_PX, BLOCK_ROWS = 0.25, (4, 32)
#: Padded scene, response, and charge (changed in place).
_ExposureArrays = tuple[Float32[np.ndarray, "padded_rows padded_columns"], Image, Image]


@dataclass(frozen=True)
class ImageMotion:
    """Image velocity on a grid of pixels.

    `velocity_px_s` contains rows and columns per second at the nodes of a grid of at least 2 x 2. The first node is
    pixel (0, 0), the spacing is `GRID_STEP_PX`; the velocity is constant beyond the last node.
    """

    velocity_px_s: Float64[np.ndarray, "n m 2"]

    @classmethod
    def from_camera(
        cls,
        camera: CameraModel,
        range_m: Float[np.ndarray, "rows columns"],
        world_from_body: RigidTransform,
        velocity_m_s: Vector,
        rate_rad_s: Vector,
    ) -> ImageMotion:
        """Compute the image motion of a camera (body frame) on a moving body over a static world.

        - range_m: distance along each pixel's ray; infinite without an object
        - world_from_body: pose of the body at mid exposure
        - velocity_m_s, rate_rad_s: velocity of the body's origin and its angular rate, world axes
        """
        rows, columns = range_m.shape
        v, u = np.meshgrid(_grid_nodes(rows), _grid_nodes(columns), indexing="ij")
        origins, directions = camera.rays(np.stack([u, v], axis=-1))
        pixel = (np.minimum(v.astype(np.int64), rows - 1), np.minimum(u.astype(np.int64), columns - 1))
        distance = np.minimum(range_m[pixel].astype(np.float64), SKY_DISTANCE_M)
        points = origins + distance[..., None] * directions
        body_from_world = world_from_body.rotation.inv()
        point_velocities = -body_from_world.apply(velocity_m_s) - np.cross(body_from_world.apply(rate_rad_s), points)
        pixels = np.einsum("...ij,...j->...i", camera.projection_jacobian(points), point_velocities)
        # nodes outside the field of view have zero motion; no pixel of the image uses them
        return cls(np.ascontiguousarray(np.nan_to_num(pixels[..., ::-1])))

    @property
    def max_px_s(self) -> float:
        """Maximum speed of the nodes, pixels per second."""
        return float(np.hypot(*np.moveaxis(self.velocity_px_s, -1, 0)).max())

    def is_still(self, duration_s: float) -> bool:
        """Return whether all motion within `duration_s` is below `STILL_PX`."""
        return self.max_px_s * duration_s < STILL_PX


def _grid_nodes(extent: int) -> Float64[np.ndarray, "nodes"]:
    count = max(2, int(np.ceil((extent - 1) / GRID_STEP_PX)) + 1)
    return GRID_STEP_PX * np.arange(count, dtype=np.float64)


def moving_exposure(
    scene: Image, response: Image, motion: ImageMotion, exposure_s: float, transfer_row_s: float, clear_row_s: float
) -> Image:
    """Compute the exposure of every pixel to a moving scene, including clearing and transfer, radiance x seconds.

    The scene is assumed constant beyond the image border. At 60 deg/s (4.9 pixels per exposure of the descent camera)
    this causes an RMS error of 1.2 % of the mean in the outermost pixels (Gusev from 2 km), 0.5 % in the next pixels,
    and less than 0.15 % from the third pixel on, which is a seventh of the noise at SNR 100:1.

    - scene: radiance at mid exposure
    - response: relative response of every pixel
    - transfer_row_s, clear_row_s: time per row during the transfer and the clearing
    """
    max_time_s = 0.5 * exposure_s + len(scene) * max(transfer_row_s, clear_row_s)
    # margins of 3 and 2 pixels for the interpolation kernels
    pad = int(np.ceil(motion.max_px_s * max_time_s)) + 3
    blur_pad = int(np.ceil(0.5 * motion.max_px_s * exposure_s)) + 2
    padded = np.pad(scene, pad, mode="edge")
    blur_scene = np.pad(scene, ((blur_pad, blur_pad), (blur_pad, blur_pad + 3)), mode="edge")
    charge = np.empty_like(scene)
    blur(blur_scene, blur_pad, motion.velocity_px_s, GRID_STEP_PX, exposure_s, charge)
    charge *= np.float32(exposure_s)
    charge *= response
    arrays = (padded, response, charge)
    if transfer_row_s > 0.0:
        _add_smear(arrays, motion, 0.5 * exposure_s, transfer_row_s)
    if clear_row_s > 0.0:
        _add_clearing(arrays, motion, 0.5 * exposure_s, clear_row_s)
    return charge


def _add_clearing(arrays: _ExposureArrays, motion: ImageMotion, start_s: float, row_s: float) -> None:
    """Add the smear of the clearing, which equals the transfer of the vertically flipped image with reversed time."""
    padded, response, charge = arrays
    rows = len(response)
    # velocities at the nodes of the flipped image: time reversal changes the sign of both components, the flip changes
    # that of the row component again
    positions = np.clip((rows - 1 - _grid_nodes(rows)) / GRID_STEP_PX, 0.0, len(motion.velocity_px_s) - 1.0)
    node = np.minimum(positions.astype(np.int64), len(motion.velocity_px_s) - 2)
    fraction = (positions - node)[:, None, None]
    flipped = (1.0 - fraction) * motion.velocity_px_s[node] + fraction * motion.velocity_px_s[node + 1]
    reversed_motion = ImageMotion(np.ascontiguousarray(flipped * np.array([1.0, -1.0])))
    clearing_charge = np.zeros_like(charge)
    flipped_arrays = (np.ascontiguousarray(padded[::-1]), np.ascontiguousarray(response[::-1]), clearing_charge)
    _add_smear(flipped_arrays, reversed_motion, start_s, row_s)
    charge += clearing_charge[::-1]


def _add_smear(arrays: _ExposureArrays, motion: ImageMotion, start_s: float, row_s: float) -> None:
    """Add the smear of the transfer, which starts `start_s` after mid exposure, to the charge."""
    padded, response, charge = arrays
    rows = len(response)
    block_rows = int(np.clip(BLOCK_PX / max(motion.max_px_s * row_s, 1e-12), *BLOCK_ROWS))
    edges = np.append(np.arange(0, rows, block_rows), rows).astype(np.int64)
    pad = (len(padded) - rows) // 2
    transfer = Transfer(padded, pad, response, edges, motion.velocity_px_s, GRID_STEP_PX, start_s, row_s)
    add_smear(transfer, gather_blocks(transfer, cumulative_row_sums(padded), average_blocks(response, edges)), charge)
