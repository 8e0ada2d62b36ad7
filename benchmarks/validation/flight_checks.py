"""Checks of the simulated world: statistics of rendered images compared with those of images from Mars.

The limits are derived from Spirit's descent images (the public copies, which have 843 x 843 pixels), HiRISE
orthoimages, and mast images of both rovers. Some terrains of `sim/terrain/sites.toml` are fitted to these images: there
the agreement is no independent test. "Flown" values were measured in images from Mars.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import marsyard
from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.dimes.details import TRACK_COLUMNS
from marsyard.sim.image_statistics import ImageStatistics, compute_image_statistics
from marsyard.site_images import ImageRequest, render_images

#: Altitudes of two of Spirit's descent images, metres.
ALTITUDES_M = (1433.0, 1983.0)
#: Azimuths and elevation of mast images, degrees; like the compared images from Mars, they do not contain the horizon.
AZIMUTHS_DEG, ELEVATION_DEG = (0.0, 90.0, 180.0, 270.0), -35.0


def _render_statistics(site: str, camera: str, **values: float | int) -> ImageStatistics:
    """Compute the statistics of one rendered image; `values` are those of `ImageRequest`."""
    image = render_images(ImageRequest.from_defaults(site, camera, **values), both=False)[0]
    return compute_image_statistics(image.to_uint16().astype(np.float64))


def compare_descent_images(quick: bool) -> Iterator[Measure]:
    """Compare descent images over Gusev and Meridiani with Spirit's descent images."""
    for site in ("gusev", "meridiani"):
        seeds = range(1, 4 if quick else 21)
        rows = [
            _render_statistics(site, "mer-descent-flown", altitude_m=altitude, seed=seed)
            for seed in seeds
            for altitude in ALTITUDES_M
        ]
        median = ImageStatistics(*np.median(rows, axis=0))
        patchiness_range = np.diff(np.percentile([row.patchiness for row in rows], [10.0, 90.0]))
        how, name = f"median of {len(rows)} images of {len(seeds)} terrains", f"descent over {site}"
        yield Measure(f"patchiness, {name}", median.patchiness, "1", 2.6, f"{how}; Spirit: 2.83 to 3.00", "at least")
        yield Measure(f"patchiness, {name}, upper limit", median.patchiness, "1", 3.3, f"{how}; HiRISE: 2.67 to 3.31")
        yield Measure(f"10 to 90 % range of patchiness, {name}", float(patchiness_range[0]), "1", 0.5, how, "at least")
        yield Measure(f"slope of the spectrum, {name}", median.slope, "1", -2.0, f"{how}; Spirit: -2.24 to -2.94")
        claim = f"slope of the spectrum, {name}, lower limit"
        yield Measure(claim, median.slope, "1", -2.9, how, "at least")
        claim = f"contrast of the smoothest tenth, {name}"
        yield Measure(claim, median.local_p10, "1", 0.042, f"{how}; Spirit: 0.036 to 0.038")
        yield Measure(
            f"brightness of corners divided by centre, {name}", median.corner, "1", None, f"{how}; cos^4 of the lens"
        )


def compare_mast_images(quick: bool) -> Iterator[Measure]:
    """Compare mast images with those of both rovers."""
    for site, reference in (("gusev", "Spirit: 0.061 to 0.065"), ("meridiani", "Opportunity: 0.046 to 0.055")):
        seeds = range(1, 2 if quick else 6)
        rows = [
            _render_statistics(site, "mer-navcam", azimuth_deg=azimuth, elevation_deg=ELEVATION_DEG, seed=seed)
            for seed in seeds
            for azimuth in AZIMUTHS_DEG
        ]
        contrast = float(np.median([row.local_p50 for row in rows]))
        how = f"median of {len(rows)} images of {len(seeds)} terrains; {reference}"
        claim = f"contrast of blocks of mast images, {site}"
        yield Measure(claim, contrast, "1", 0.045, how, "at least")
        yield Measure(f"{claim}, upper limit", contrast, "1", 0.075, how)


#: Minimum and maximum over the four DIMES templates of Spirit's descent images: width of the correlation peak, px, and
#: ratio of the second to the first peak.
FLOWN_WIDTHS_PX, FLOWN_SECOND_PEAKS = (3.3, 15.6), (0.40, 0.82)
#: 95 % confidence interval (Clopper and Pearson) of the fraction of refused templates: one of the four was refused.
FLOWN_REFUSED_FRACTION = (0.006, 0.806)


def compare_templates(quick: bool) -> Iterator[Measure]:
    """Compare the correlation peaks of DIMES' templates in `dimes-gusev` with those of the four flown templates.

    The range of the simulated values must contain the range of the flown values.
    """
    campaign = marsyard.load_campaign("dimes-gusev", {"location.bank": 8})
    products = [marsyard.run_case(campaign, case).products for case in range(1, 4 if quick else 41)]
    tracks = np.concatenate([product["tracks"] for product in products if "tracks" in product])
    width, second, valid = (
        tracks[:, TRACK_COLUMNS.index(name)] for name in ("peak_width", "second_peak_ratio", "valid")
    )
    how = f"{len(tracks)} templates of {len(products)} cases of dimes-gusev; Spirit: four templates"
    for name, values, (low, high) in (
        ("width of the correlation peak, px", width, FLOWN_WIDTHS_PX),
        ("second peak divided by first peak", second, FLOWN_SECOND_PEAKS),
    ):
        low_5, median, high_95 = np.percentile(values, (5.0, 50.0, 95.0))
        text = f"{how}; median {median:.2g}, 5 to 95 % {low_5:.2g} to {high_95:.2g}"
        yield Measure(f"{name}: minimum", float(values.min()), "1", low, text)
        yield Measure(f"{name}: maximum", float(values.max()), "1", high, text, "at least")
    refused_fraction = float(np.mean(valid == 0.0))
    yield Measure("refused templates", refused_fraction, "1", FLOWN_REFUSED_FRACTION[1], f"{how}, one refused")
    claim = "refused templates, lower limit"
    yield Measure(claim, refused_fraction, "1", FLOWN_REFUSED_FRACTION[0], f"{how}, one refused", "at least")


CHECKS = (
    Check("flight", "Images from Mars", compare_descent_images),
    Check("flight-templates", "Images from Mars", compare_templates),
    Check("flight-mast", "Images from Mars", compare_mast_images),
)
