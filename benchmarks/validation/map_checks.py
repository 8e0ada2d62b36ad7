"""Checks of descent images on maps: yields of features and correlations of templates, compared with those from Mars.

The flown values are those of five frames of Mars 2020's landing camera, 4 to 3 km above Jezero, on a map of 16 m a
pixel from orbital images (public copies), measured by the same function (`compute_map_statistics`).
"""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float, Float64

from benchmarks.validation.flight_checks import FIRST_SEED, copy_image
from benchmarks.validation.image_statistics import MapStatistics, compute_map_statistics
from benchmarks.validation.records import Check, Measure
from marsyard.reports.validation_rows import Conditions
from marsyard.scenarios.localisation.camera import true_camera
from marsyard.scenarios.localisation.parameters import LocalisationScenarioParameters
from marsyard.scenarios.localisation.simulation import LocalisedDescent
from marsyard.scenarios.localisation.sites import localisation_site
from marsyard.sim.camera import CameraModel
from marsyard.sim.streams import Streams

#: Size of a map pixel to which map and images are reduced, m; half the field of view of the rectified images, degrees.
PIXEL_M, HALF_FIELD_DEG = 16.0, 40.0
#: Side of the rectified images before their reduction, pixels.
_RECTIFIED_PX = 700
#: Side of the public copies of the flown images, pixels.
_COPY_PX = 800
#: Sun of the orbital images, and of the landing of Mars 2020 (Mars24 formulas): azimuth and elevation, degrees. The
#: azimuth in the orbital images is that at which the power spectrum of the map of Jezero is largest, 275 to 281 deg
#: (the same for the frames gives 256 to 264 deg); the elevation is assumed. And rotation of the sun of the landing
#: about the vertical in the second comparison.
MAP_SUN_DEG, LANDING_SUN_DEG, TURN_DEG = (278.0, 40.0), (257.0, 39.7), 120.0
#: Times of the images after the start at 4.2 km, s: heights of about 4.1, 3.2 and 2.3 km.
_FIRST_S, _INTERVAL_S, _IMAGES = 0.5, 10.0, 3
SUNS = "suns 16 deg apart"
#: All sites, and the one that resembles the flown one.
SITES, FLOWN_SITE = ("crater-floor", "dunes", "highland", "plain"), "crater-floor"
#: Range of the median correlation of templates under nearly equal suns; maximum fraction of images that are not found.
CORRELATION, MAX_LOST = (0.6, 0.8), 0.1
#: Minimum and maximum over the flown frames; the strongest templates are compared with all.
FLOWN = {
    "sift": "0.133 to 0.165",
    "orb": "0.068 to 0.138",
    "correlation": "0.63 to 0.70",
    "strongest": "0.70 to 0.87 and 0.63 to 0.70",
}


def rectify(image: Float[np.ndarray, "rows columns"], camera: CameraModel) -> Float64[np.ndarray, "side side"]:
    """Resample an image of a camera that looks along -z to a pinhole image of the field of view of the checks."""
    focal_px = 0.5 * _RECTIFIED_PX / np.tan(np.radians(HALF_FIELD_DEG))
    offset = (np.arange(_RECTIFIED_PX) - 0.5 * (_RECTIFIED_PX - 1)) / focal_px
    x, y = np.meshgrid(offset, -offset)
    pixels, _ = camera.project(np.stack([x, y, -np.ones_like(x)], axis=-1))
    u, v = np.moveaxis(pixels.astype(np.float32), -1, 0)
    return cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR).astype(np.float64)


def reduce_to_map(image: Float[np.ndarray, "side side"], height_m: float) -> Float64[np.ndarray, "small small"]:
    """Average a rectified image, taken at a height above level ground, to pixels of the map's size."""
    side = round(2.0 * height_m * np.tan(np.radians(HALF_FIELD_DEG)) / PIXEL_M)
    return np.asarray(cv2.resize(image, (side, side), interpolation=cv2.INTER_AREA))


def decimate_map(appearance: Float[np.ndarray, "rows rows"], pixel_m: float) -> Float64[np.ndarray, "side side"]:
    """Reduce a map to `PIXEL_M` as the copy of the flown map was: by interpolation, without an average over its pixels.

    The spectrum of the copy shows it: up to its Nyquist frequency, the amplitude falls as frequency**-0.95. An average
    over 16 m would divide it by 1.6 there; instead it is 3 to 10 % larger, because finer detail aliases.
    """
    side = round(len(appearance) * pixel_m / PIXEL_M)
    return cv2.resize(appearance, (side, side), interpolation=cv2.INTER_LINEAR).astype(np.float64)


def compare_on_map(site: str, seed: int, turn_deg: float) -> list[MapStatistics]:
    """Simulate a descent, and compare its images with the map; images without a homography have NaN."""
    parameters = LocalisationScenarioParameters.model_validate(
        {
            "site": site,
            "location": {"bank_seed": seed, "east_m": 6000.0, "north_m": 6000.0},
            "sun": {"azimuth_deg": LANDING_SUN_DEG[0] + turn_deg, "elevation_deg": LANDING_SUN_DEG[1]},
            "map": {"sun_azimuth_deg": MAP_SUN_DEG[0], "sun_elevation_deg": MAP_SUN_DEG[1]},
            "flight": {"altitude_end_m": 2000.0},
            "images": {
                "first_s": _FIRST_S, "coarse_images": _IMAGES, "coarse_interval_s": _INTERVAL_S, "interval_s": 60.0
            },
        }
    )  # fmt: skip
    descent = LocalisedDescent.simulate(parameters, Streams(seed, "flight-map", 0))
    product, camera = descent.measurements.map_product, true_camera(parameters.camera)
    # row 0 of the map product is in the south
    mapped = decimate_map(product.appearance[::-1], product.pixel_m)
    rows = []
    for image, state in zip(descent.images, descent.image_states, strict=True):
        x, y, z = state.position_m.tolist()
        copied = cv2.resize(copy_image(image.counts, _COPY_PX), image.counts.shape[::-1])
        small = reduce_to_map(rectify(copied, camera), z - float(descent.world.surface.height(x, y)))
        rows.append(compute_map_statistics(small, mapped) or MapStatistics(*[np.nan] * len(MapStatistics._fields)))
    return rows


def compare_maps(quick: bool) -> Iterator[Measure]:
    """Compare images with maps under nearly equal suns, and under a sun that is turned about the vertical.

    The limits apply to the site that resembles the flown one; no flown images of the other sites were available.
    """
    for site in (FLOWN_SITE,) if quick else SITES:
        seeds = range(FIRST_SEED, FIRST_SEED + (1 if quick or site != FLOWN_SITE else 6))
        equal, turned = (
            np.array([row for seed in seeds for row in compare_on_map(site, seed, turn_deg)])
            for turn_deg in (0.0, TURN_DEG)
        )
        how = f"median of {len(equal)} images of {len(seeds)} terrains, {SUNS}"
        low, high, min_ratio, max_lost = (*CORRELATION, 1.0, MAX_LOST) if site == FLOWN_SITE else (None,) * 4
        where = f"descent on map, {site}"
        for name, rows, text in (("", equal, how), (", sun turned", turned, f"{how}, turned by {TURN_DEG:g} deg")):
            is_found = np.isfinite(rows[:, 0])
            lost = 1.0 - float(is_found.mean())
            yield Measure(f"images that are not found, {where}{name}", lost, "", None if name else max_lost, text)
            if not is_found.any():
                continue
            median = MapStatistics(*np.median(rows[is_found], axis=0))
            if not name:
                yield from _compare_equal_suns(median, where, how, (low, high, min_ratio))
            ratio = median.strongest / median.correlation
            text = f"{text}; {median.strongest:.2f} and {median.correlation:.2f}; Mars 2020: {FLOWN['strongest']}"
            claim = f"correlation of the strongest templates divided by that of all, {where}{name}"
            yield Measure(claim, ratio, "1", min_ratio, text, "at least")


def _compare_equal_suns(
    median: MapStatistics, where: str, how: str, limits: tuple[float | None, float | None, float | None]
) -> Iterator[Measure]:
    """Compare the correlation of templates, and the yields of SIFT and ORB, under nearly equal suns."""
    low, high, min_ratio = limits
    claim, flown = f"correlation of templates, {where}", f"{how}; Mars 2020: {FLOWN['correlation']}"
    yield Measure(claim, median.correlation, "1", low, flown, "at least")
    if high is not None:
        yield Measure(f"{claim}, upper limit", median.correlation, "1", high, flown)
    yields = f"{how}; {median.sift:.3f} and {median.orb:.3f}; Mars 2020: {FLOWN['sift']} and {FLOWN['orb']}"
    ratio = median.sift / median.orb
    yield Measure(f"yield of SIFT divided by yield of ORB, {where}", ratio, "1", min_ratio, yields, "at least")


def _conditions(name: str) -> Conditions:
    """Conditions of the descents to a site."""
    site, sun = localisation_site(name), (LANDING_SUN_DEG[1], LANDING_SUN_DEG[1])
    slope, depth = site.terrain("descent").rms_slope_deg, site.environment.optical_depth
    return Conditions(
        f"*descent on map, {name}*",
        ("localisation",),
        "lcam-frames",
        site=(name,),
        camera=("lander vision camera",),
        sun_elevation_deg=sun,
        slope_deg=(slope, slope),
        optical_depth=(depth, depth),
        range_m=(2300.0, 4100.0),
    )


CHECKS = (Check("flight-map", "Images from Mars", compare_maps, conditions=tuple(map(_conditions, SITES))),)
