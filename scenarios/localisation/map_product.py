"""Map product of a landing site: appearance from orbital images, orthorectified, and elevation, with their errors.

Position errors: the surface point at world position w appears at the map position ``m = w + shift + d(m)``: a shift of
the whole map, and a smooth random displacement field d. The brightness of a map pixel is that along the ray from the
orbiter to the surface point of the pixel. This is exact orthorectification: it equals the projection of the surface
point into an orbital image, without an interpolation between the image's pixels.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float64
from numpy.random import Generator
from scipy.interpolate import RectBivariateSpline

from marsyard.algorithms.localisation.interface import MapProduct
from marsyard.scenarios.localisation.map_rendering import Coordinates, Grid, render_map, world_grid
from marsyard.scenarios.localisation.map_truth import MapTruth, SmoothField
from marsyard.scenarios.localisation.parameters import MapParameters
from marsyard.scenarios.localisation.world import LocalisationWorld
from marsyard.sim.render.backend import Backend
from marsyard.sim.terrain import Surface

#: Quantile of the brightness that becomes the largest count of the map, and step between pixels for this quantile.
_WHITE_QUANTILE, _QUANTILE_STEP = 0.999, 4
#: Margin of error fields around the map, m: positions near its border can be inverted.
_FIELD_MARGIN_M = 500.0


def make_map(
    world: LocalisationWorld,
    parameters: MapParameters,
    centre_m: Float[np.ndarray, "2"],
    rng: Generator,
    backend: Backend,
) -> tuple[MapProduct, MapTruth]:
    """Make a map of the ground around `centre_m` (world x, y), and return its true errors.

    The steps: position errors, rendering along the rays from the orbiter through the whole atmosphere under the
    orbital images' own sun and dust, blur, noise, quantisation; elevation of the posts and its error.
    """
    p = parameters
    half_m = 0.5 * (p.side_px - 1) * p.pixel_m
    origin = np.asarray(centre_m, dtype=np.float64) - half_m
    x, y = (start + p.pixel_m * np.arange(p.side_px) for start in origin)
    extent = origin - _FIELD_MARGIN_M, origin + 2.0 * half_m + _FIELD_MARGIN_M
    shift = p.registration_sd_m * rng.standard_normal(2)
    distortion_x, distortion_y = (
        SmoothField.draw(*extent, p.distortion_sd_m, p.distortion_length_m, rng) for _ in range(2)
    )
    elevation_error = SmoothField.draw(*extent, p.elevation_sd_m, p.elevation_length_m, rng)
    truth = MapTruth(shift, distortion_x, distortion_y, elevation_error, 1.0)

    elevation = _elevation(world.surface, p, truth, x, y)
    elevation += elevation_error.on_grid(x, y)
    elevation = elevation.astype(np.float32)
    appearance = render_map(world.ground, p, np.asarray(centre_m, dtype=np.float64), truth, (x, y), backend)
    appearance = blur(appearance, p.nyquist_mtf)
    noise = rng.standard_normal(appearance.shape, dtype=np.float32)
    appearance += noise * np.float32(appearance.mean(dtype=np.float64) / p.signal_to_noise)
    if p.bits is not None:
        top = 2**p.bits - 1
        white = np.quantile(appearance[::_QUANTILE_STEP, ::_QUANTILE_STEP], _WHITE_QUANTILE)
        truth = replace(truth, counts_per_radiance=top / float(white))
        appearance = np.clip(np.rint(appearance * np.float32(truth.counts_per_radiance)), 0.0, top)

    product = MapProduct(
        appearance=appearance.astype(np.float32, copy=False),
        elevation_m=elevation,
        origin_m=origin,
        pixel_m=p.pixel_m,
        registration_sd_m=p.registration_sd_m,
        distortion_sd_m=p.distortion_sd_m,
        elevation_sd_m=p.elevation_sd_m,
    )
    return product, truth


def blur(image: Grid, nyquist_mtf: float) -> Grid:
    """Filter an image by a Gaussian whose modulation transfer at one cycle per two pixels is `nyquist_mtf`.

    The transfer of a Gaussian with the standard deviation s, pixels, is ``exp(-2 (pi s f)**2)``.
    """
    if nyquist_mtf == 1.0:
        return image
    sd_px = np.sqrt(-2.0 * np.log(nyquist_mtf)) / np.pi
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sd_px, borderType=cv2.BORDER_REFLECT_101), dtype=np.float32)


def _elevation(
    surface: Surface, p: MapParameters, truth: MapTruth, x: Coordinates, y: Coordinates
) -> Float64[np.ndarray, "rows columns"]:
    """Return the elevation of the map's pixels: exact, or interpolated by cubic splines between posts.

    A post has the height of the terrain level with the next smaller spacing: stereo correlation averages over a post.
    """
    if p.elevation_post_m == 0.0:
        return surface.height(*world_grid(truth, x, y))
    level = int(np.clip(np.log2(p.elevation_post_m / surface.spacing_m), 0, len(surface.levels) - 1))
    posts_x, posts_y = (
        np.arange(line[0] - 2.0 * p.elevation_post_m, line[-1] + 3.0 * p.elevation_post_m, p.elevation_post_m)
        for line in (x, y)
    )
    heights = surface.height(*world_grid(truth, posts_x, posts_y), level)
    return np.asarray(RectBivariateSpline(posts_y, posts_x, heights)(y, x))
