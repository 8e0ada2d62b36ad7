"""Checks of images near the ground: statistics of rendered images compared with those of rovers and a landing camera.

The limits are ranges around the values of the images from Mars; each row states these "flown" values.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from benchmarks.validation.flight_checks import FIRST_SEED, measure_within
from benchmarks.validation.image_statistics import (
    BLOCK_PX,
    GroundStatistics,
    compute_ground_statistics,
    compute_image_statistics,
)
from benchmarks.validation.records import Check, Measure
from marsyard.image_files import truth_layers
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.terrain import sites
from marsyard.site_images import ImageRequest, RenderedImage, render_images

#: Side of the crops of ground, pixels, and angles of their upper edge below the horizon, degrees. With 384 pixels of
#: 0.047 deg a crop of a mast image ends at 25 deg.
CROP_PX, TOP_DEG = 384, 7.0
#: Azimuths of mast images, degrees, and their elevation: the mounting's default shows the horizon.
AZIMUTHS_DEG = (0.0, 90.0, 180.0, 270.0)
#: Elevation of the camera in mast images without horizon, degrees, and limits of the median contrast of their blocks
#: after reduction (`ImageStatistics.local_p50`).
DOWN_DEG, REDUCED_CONTRAST = -35.0, (0.045, 0.075)
FLOWN_REDUCED = {"gusev": "Spirit: 0.061 to 0.065", "meridiani": "Opportunity: 0.040 to 0.055"}
#: Azimuth and elevation of the sun in mast images of Spirit (2N292280938) and Opportunity (1N491020376), and elevation
#: in a hazard image of Opportunity (1F498644828), degrees: Mars24 formulas for the times of the spacecraft's clocks,
#: which agree with the label of Opportunity's mast image to 1 deg.
MAST_SUNS_DEG = {"gusev": (152.0, 81.4), "meridiani": (282.0, 41.0)}
HAZARD_SUN_DEG = (250.0, 62.6)
MAST_LIMITS = {
    "local_p10": (0.035, 0.06),
    "local_p90": (0.09, 0.13),
    "kurtosis": (0.0, 4.0),
    "corners": (10.0, 22.0),
    "darkest": (0.6, 0.75),
}
FLOWN_MAST = {
    "local_p10": "0.041, 0.074, 0.047",
    "local_p90": "0.114, 0.125, 0.099",
    "kurtosis": "2.5, 0.2, 1.8",
    "corners": "11.9, 21.0, 17.7",
    "darkest": "0.62, 0.71, 0.72",
}
#: Minimum of the sky's brightness divided by that of the ground, both within 1 to 3 deg of the horizon.
SKY_RATIO, HORIZON_BAND_DEG = 1.27, (1.0, 3.0)
#: Maximum range of the compared ground in front of a rover, metres, and ranges of the brightness of its shadow divided
#: by that of the sunlit ground, and of the contrast of blocks in the shadow.
MAX_HAZARD_RANGE_M, SHADOW_RATIO, SHADOW_CONTRAST = 3.0, (0.14, 0.22), (0.05, 0.1)
HELICOPTER_LIMITS, FLOWN_HELICOPTER = (
    {"kurtosis": (1.0, 5.0), "corners": (12.0, 20.0)},
    {"kurtosis": "about 3", "corners": "13 to 18"},
)


def _render(site: str, camera: str, **values: float | int) -> RenderedImage:
    """Render the left image of a camera; `values` are those of `ImageRequest`."""
    return render_images(ImageRequest.from_defaults(site, camera, **values), both=False)[0]


def _depressions_deg(image: RenderedImage) -> Float64[np.ndarray, "rows"]:
    """Depression of the rays in the middle column of an image below the horizon, degrees."""
    rows, columns = image.frame.range_m.shape
    directions = image.frame.rays.directions.reshape(rows, columns, 3)[:, columns // 2].astype(np.float64)
    up = image.frame.world_from_body.rotation.as_matrix()[2]
    return np.asarray(np.degrees(np.arcsin(-(directions @ up))))


def crop_ground(image: RenderedImage) -> list[GroundStatistics]:
    """Compute the statistics of the crops of ground at the left, in the middle and at the right of a mast image."""
    counts = image.to_uint16().astype(np.float64)
    top = int(np.searchsorted(_depressions_deg(image), TOP_DEG))
    lefts = (0, (counts.shape[1] - CROP_PX) // 2, counts.shape[1] - CROP_PX)
    return [compute_ground_statistics(counts[top : top + CROP_PX, left : left + CROP_PX]) for left in lefts]


def sky_over_ground(image: RenderedImage) -> float:
    """Brightness of the sky over that of the ground, in bands above and below the horizon of an image."""
    depression, counts = _depressions_deg(image), image.to_uint16().astype(np.float64)
    low, high = HORIZON_BAND_DEG
    is_sky = np.isinf(image.frame.range_m) & ((depression < -low) & (depression > -high))[:, None]
    is_ground = (image.frame.body == -1) & ((depression > low) & (depression < high))[:, None]
    return float(counts[is_sky].mean() / counts[is_ground].mean())


def measure_shadow(image: RenderedImage) -> tuple[float, float]:
    """Brightness of shaded over sunlit ground in front of a rover, and median contrast of blocks in the shadow."""
    layers, counts = truth_layers(image), image.to_uint16().astype(np.float64)
    is_near = (layers["object"] == -1) & (layers["range_m"] < MAX_HAZARD_RANGE_M)
    shadow = layers["shadow"]
    blocks, inside = (
        values.reshape(values.shape[0] // BLOCK_PX, BLOCK_PX, -1, BLOCK_PX).swapaxes(1, 2).reshape(-1, BLOCK_PX**2)
        for values in (counts, is_near & shadow)
    )
    dark = blocks[inside.all(axis=1)]
    ratio = np.median(counts[is_near & shadow]) / np.median(counts[is_near & ~shadow])
    return float(ratio), float(np.median(dark.std(axis=1) / dark.mean(axis=1)))


def _compare(
    rows: list[GroundStatistics], where: str, limits: Mapping[str, tuple[float, float]], flown: Mapping[str, str]
) -> Iterator[Measure]:
    """Compare the medians of crops with limits."""
    median = GroundStatistics(*np.median(rows, axis=0))
    for name, value in median._asdict().items():
        how = f"median of {len(rows)} crops"
        if name in limits:
            yield from measure_within(f"{name}, {where}", value, limits[name], f"{how}; Mars: {flown[name]}")
        else:
            yield Measure(f"{name}, {where}", value, "1", None, how)


def render_mast(site: str, **values: float | int) -> RenderedImage:
    """Render a mast image under the sun of the site's images from Mars."""
    azimuth, elevation = MAST_SUNS_DEG[site]
    return _render(site, "mer-navcam", sun_azimuth_deg=azimuth, sun_elevation_deg=elevation, **values)


def measure_reduced_contrast(site: str, azimuth_deg: float, seed: int) -> float:
    """Median contrast of the blocks of a mast image that is reduced by area."""
    image = render_mast(site, azimuth_deg=azimuth_deg, elevation_deg=DOWN_DEG, seed=seed)
    return compute_image_statistics(image.to_uint16().astype(np.float64)).local_p50


def render_hazard(site: str, seed: int) -> RenderedImage:
    """Render a hazard image with the sun behind the rover."""
    azimuth, elevation = HAZARD_SUN_DEG
    view = {"azimuth_deg": azimuth - 180.0, "sun_azimuth_deg": azimuth, "sun_elevation_deg": elevation}
    return _render(site, "mer-hazcam", seed=seed, **view)


def compare_ground_images(quick: bool) -> Iterator[Measure]:
    """Compare mast, hazard and helicopter images with those from Mars."""
    seeds = range(FIRST_SEED, FIRST_SEED + (1 if quick else 20))
    for site in ("gusev", "meridiani"):
        yield from _compare(
            [
                row
                for seed in seeds
                for azimuth in AZIMUTHS_DEG
                for row in crop_ground(render_mast(site, azimuth_deg=azimuth, seed=seed))
            ],
            f"mast images over {site}",
            MAST_LIMITS,
            FLOWN_MAST,
        )
        contrasts = [measure_reduced_contrast(site, azimuth, seed) for seed in seeds for azimuth in AZIMUTHS_DEG]
        how = f"median of {len(contrasts)} images without horizon; {FLOWN_REDUCED[site]}"
        claim = f"local_p50 of reduced images, mast images over {site}"
        yield from measure_within(claim, float(np.median(contrasts)), REDUCED_CONTRAST, how)
        away: dict[str, Any] = {"azimuth_deg": MAST_SUNS_DEG[site][0] - 180.0, "elevation_deg": 0.0}
        ratio = np.median([sky_over_ground(render_mast(site, seed=seed, **away)) for seed in seeds])
        # the flown value is Opportunity's
        limit = SKY_RATIO if site == "meridiani" else None
        how = f"median of {len(seeds)} images away from the sun; Opportunity: at least {SKY_RATIO}"
        yield Measure(f"sky over ground at the horizon, {site}", float(ratio), "1", limit, how, "at least")
        shadows = [measure_shadow(render_hazard(site, seed)) for seed in seeds]
        dark, contrast = np.median(shadows, axis=0)
        how = f"median of {len(shadows)} hazard images, sun behind the rover; Mars: "
        yield from measure_within(f"shadow over sunlit ground, {site}", float(dark), SHADOW_RATIO, f"{how}0.14 to 0.21")
        claim = f"contrast in the rover's shadow, {site}"
        yield from measure_within(claim, float(contrast), SHADOW_CONTRAST, f"{how}0.064 to 0.094")
    for site in ("heli-hazardous", "gusev"):
        crops = []
        for seed in seeds:
            counts = _render(site, "xc-55", seed=seed).to_uint16().astype(np.float64)
            top, left = ((side - CROP_PX) // 2 for side in counts.shape)
            crops.append(compute_ground_statistics(counts[top : top + CROP_PX, left : left + CROP_PX]))
        limits = HELICOPTER_LIMITS if site == "heli-hazardous" else {}
        yield from _compare(crops, f"{site} from 10 m", limits, FLOWN_HELICOPTER)


def _conditions(rows: str, name: str, data: str, camera: str, sun_deg: float) -> Conditions:
    """Conditions of rows on the ground of a site."""
    parameters = sites()[name]
    slope, depth = parameters.terrain("ground").rms_slope_deg, parameters.environment.optical_depth
    sun = (sun_deg, sun_deg)
    return Conditions(
        rows,
        ("vtt", "hda"),
        data,
        site=(name,),
        camera=(camera,),
        sun_elevation_deg=sun,
        slope_deg=(slope, slope),
        optical_depth=(depth, depth),
    )


CHECKS = (
    Check(
        "flight-ground",
        "Images from Mars",
        compare_ground_images,
        conditions=(
            *(
                condition
                for name, (_, sun_deg) in MAST_SUNS_DEG.items()
                for condition in (
                    _conditions(f"*, mast images over {name}*", name, "mast-images", "mer-navcam", sun_deg),
                    _conditions(f"sky over ground*, {name}*", name, "sky-images", "mer-navcam", sun_deg),
                    _conditions(f"*shadow*, {name}*", name, "hazard-images", "mer-hazcam", HAZARD_SUN_DEG[1]),
                )
            ),
            *(
                replace(
                    _conditions(f"*, {name} from 10 m*", name, "helicopter-images", "xc-55", 35.0), range_m=(10.0, 10.0)
                )
                for name in ("heli-hazardous", "gusev")
            ),
        ),
    ),
)
