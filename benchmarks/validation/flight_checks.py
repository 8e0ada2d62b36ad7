"""Checks of the simulated world: statistics of rendered images compared with those of images from Mars.

The limits are derived from three descent images of Spirit (public copies of 843 x 843 pixels), pairs of them, and four
templates of DIMES. Some terrains of `sim/terrain/sites.toml` are fitted to them: there
the agreement is no independent test. "Flown" values were measured in images from Mars.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
from jaxtyping import Float, Float64

import marsyard
from benchmarks.validation.image_statistics import (
    ImageStatistics,
    PairStatistics,
    compute_image_statistics,
    compute_pair_statistics,
)
from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.dimes.products import TRACK_COLUMNS
from marsyard.reports.validation_rows import Conditions
from marsyard.scenarios.descent.scenario import DescentScenario
from marsyard.sim.sensor import preset
from marsyard.sim.terrain.sites import sites
from marsyard.site_images import ImageRequest, render_images

#: Altitudes of two of Spirit's descent images, metres.
ALTITUDES_M = (1433.0, 1983.0)
#: Azimuth and elevation of the sun at the landings of Spirit and Opportunity, degrees: Mars24 formulas for the times of
#: the landings, which are good to ten minutes (2.5 deg).
SUNS_DEG = {"gusev": (268.0, 56.9), "meridiani": (248.0, 70.8)}
#: Ranges that the medians over Gusev must have; those of Spirit's three images follow in `FLOWN`.
LIMITS = {
    "patchiness": (2.6, 3.3),
    "slope": (-3.0, -2.1),
    "local_p10": (0.033, 0.042),
    "local_p50": (0.050, 0.064),
    "local_p90": (0.095, 0.120),
    "kurtosis_4": (4.0, 9.0),
    "kurtosis_8": (3.0, 13.0),
    "best_template": (0.048, 0.078),
    "sift": (50.0, 110.0),
}
FLOWN = {
    "patchiness": "2.83 to 3.00",
    "slope": "-2.9 to -2.2",
    "local_p10": "0.036 to 0.038",
    "local_p50": "0.055 to 0.060",
    "local_p90": "0.104 to 0.113",
    "kurtosis_4": "5.7 to 8.5",
    "kurtosis_8": "3.8 to 12.4",
    "best_template": "0.055 to 0.071",
    "sift": "66 to 89",
}
#: Statistics of the tails, of which the median over Meridiani differs from that over Gusev by at most a factor of two.
TAILS = ("kurtosis_4", "kurtosis_8", "best_template")
#: Altitude of the first image, metres, and descent rate, m/s, of the compared pairs. NASA's captions of Spirit's second
#: and third image state 1690 m and 1433 m; 1983 m is assumed for the first (near 2000 m: Johnson et al., field test of
#: DIMES). With images every 3.75 s and this rate the second image is at 1708 m, and the third at 1433 m.
PAIR_FLIGHT = {"descent.altitude_first_m": 1983.0, "descent.descent_rate_m_s": (1983.0 - 1433.0) / 7.5}
#: A descent without coning and nodding: those of Spirit are not known. Gusts move the camera nevertheless.
CALM = {"descent.cone_angle_deg": 0.0, "descent.nod_rate_deg_s": 0.0}
#: Side, pixels, of the public copies, and quality of their JPEG compression: that of Mars 2020's public copies.
COPY_PX, JPEG_QUALITY = 843, 75
PAIR_LIMITS = {"repeatability": (0.48, 0.62), "tracking_error_px": (0.3, 0.45), "decorrelation": (0.012, 0.05)}
FLOWN_PAIRS = {"repeatability": "0.54", "tracking_error_px": "0.39", "decorrelation": "0.020"}
_NO_PAIR = PairStatistics(*[np.nan] * len(PairStatistics._fields))
#: First seed of the compared terrains: parameters of the sites were set on other seeds.
FIRST_SEED = 10100
#: Number of terrains of the descent images. The median patchiness of 20 terrains has a standard deviation of 0.10
#: (bootstrap over terrains), as much as its distance to the limits.
_TERRAINS = 100


def _render_descent(site: str, **values: float | int) -> Float64[np.ndarray, "rows columns"]:
    """Render an image of the flown descent camera under the sun of the landing.

    The camera summed four rows on the chip; like the public copies, the image has square pixels again.
    """
    azimuth, elevation = SUNS_DEG[site]
    sun = {"sun_azimuth_deg": azimuth, "sun_elevation_deg": elevation}
    request = ImageRequest.from_defaults(site, "mer-descent-flown", **sun, **values)
    image = render_images(request, both=False)[0].to_uint16().astype(np.float64)
    rows_summed = preset("mer-descent-flown").detector.rows_summed
    return _stretch_rows(image.reshape(-1, rows_summed, image.shape[1]).mean(axis=1))


def _stretch_rows(summed: Float64[np.ndarray, "groups columns"]) -> Float64[np.ndarray, "columns columns"]:
    """Interpolate summed rows to square pixels."""
    columns = summed.shape[1]
    return np.asarray(cv2.resize(summed, (columns, columns), interpolation=cv2.INTER_LINEAR))


def measure_within(claim: str, value: float, limits: tuple[float, float], how: str) -> Iterator[Measure]:
    """Compare a value with a lower and an upper limit."""
    low, high = limits
    yield Measure(claim, value, "1", low, how, "at least")
    yield Measure(f"{claim}, upper limit", value, "1", high, how)


def compare_descent_images(quick: bool) -> Iterator[Measure]:
    """Compare descent images over Gusev with Spirit's, and the tails over Meridiani with those over Gusev."""
    seeds = range(FIRST_SEED, FIRST_SEED + (3 if quick else _TERRAINS))
    medians = {}
    for site in SUNS_DEG:
        rows = [
            compute_image_statistics(_render_descent(site, altitude_m=altitude, seed=seed))
            for seed in seeds
            for altitude in ALTITUDES_M
        ]
        medians[site] = ImageStatistics(*np.median(rows, axis=0))
    how = f"median of {len(rows)} images of {len(seeds)} terrains"
    for name, limits in LIMITS.items():
        value = getattr(medians["gusev"], name)
        yield from measure_within(f"{name}, descent over gusev", value, limits, f"{how}; Spirit: {FLOWN[name]}")
    for name in TAILS:
        ratio = getattr(medians["meridiani"], name) / getattr(medians["gusev"], name)
        yield from measure_within(f"{name}, descent over meridiani divided by gusev", ratio, (0.5, 2.0), how)
    for site, median in medians.items():
        claim = f"brightness of corners divided by centre, descent over {site}"
        yield Measure(claim, median.corner, "1", None, f"{how}; cos^4 of the lens")


def copy_image(image: Float[np.ndarray, "rows columns"], side: int) -> Float64[np.ndarray, "side side"]:
    """Reduce and compress an image like the public copies: brightest pixels at full scale, JPEG."""
    white = np.clip(image * (255.0 / np.quantile(image, 0.999)), 0.0, 255.0)
    small = np.rint(cv2.resize(white, (side, side), interpolation=cv2.INTER_AREA)).astype(np.uint8)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.float64)


def measure_pairs(cases: int, changes: Mapping[str, float]) -> PairStatistics:
    """Compute the mean over the pairs of three images, and the median over cases of `dimes-gusev` under Spirit's sun.

    The images have the detector, optics, motion, haze and dispersions of the campaign. `changes` replace dispersions.
    """
    sun = dict(zip(("sun.azimuth_deg", "sun.elevation_deg"), SUNS_DEG["gusev"], strict=True))
    campaign = marsyard.load_campaign(
        "dimes-gusev", {"location.bank_seed": FIRST_SEED, **sun, **PAIR_FLIGHT, **changes}
    )
    rows = []
    for case in range(cases):
        samples = DescentScenario().samples(campaign.parameters(case), campaign.streams(case))
        images = [copy_image(_stretch_rows(sample.image.astype(np.float64)), COPY_PX) for sample in samples]
        pairs = [compute_pair_statistics(first, second) for first, second in combinations(images, 2)]
        rows.append(np.mean([pair for pair in pairs if pair is not None] or [_NO_PAIR], axis=0))
    return PairStatistics(*np.median(rows, axis=0))


def compare_descent_pairs(quick: bool) -> Iterator[Measure]:
    """Compare pairs of the images of `dimes-gusev` with Spirit's pairs, at the altitudes of Spirit's images."""
    cases = 2 if quick else 20
    calm, dispersed = (measure_pairs(cases, changes) for changes in (CALM, {}))
    how = f"means of three pairs of images of dimes-gusev, median of {cases} descents; Spirit: "
    for name, limits in PAIR_LIMITS.items():
        claim, flown = f"{name}, pairs of descent images over gusev", f"{how}{FLOWN_PAIRS[name]}"
        yield from measure_within(claim, getattr(calm, name), limits, f"{flown}; without coning and nodding")
        yield Measure(f"{claim}, dispersed attitudes", getattr(dispersed, name), "1", None, flown)


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


#: Optical depth of both sites.
_OPTICAL_DEPTH = (0.9, 0.9)
_DESCENT = Conditions(
    "*gusev",
    ("dimes",),
    "spirit-descent",
    site=("gusev",),
    camera=("mer-descent-flown",),
    sun_elevation_deg=(SUNS_DEG["gusev"][1],) * 2,
    slope_deg=(sites()["gusev"].terrain("descent").rms_slope_deg,) * 2,
    optical_depth=_OPTICAL_DEPTH,
    range_m=ALTITUDES_M,
)
_MERIDIANI = replace(
    _DESCENT,
    rows="*meridiani*",
    site=("meridiani",),
    sun_elevation_deg=(SUNS_DEG["meridiani"][1],) * 2,
    slope_deg=(sites()["meridiani"].terrain("descent").rms_slope_deg,) * 2,
)
CHECKS = (
    Check(
        "flight", "Images from Mars", compare_descent_images, conditions=(_MERIDIANI, replace(_DESCENT, rows="*gusev*"))
    ),
    Check(
        "flight-pairs",
        "Images from Mars",
        compare_descent_pairs,
        conditions=(replace(_DESCENT, rows="*", optical_depth=(0.6, 1.2)),),
    ),
    Check(
        "flight-templates",
        "Images from Mars",
        compare_templates,
        # the dispersions of dimes-gusev
        conditions=(
            replace(
                _DESCENT,
                rows="*",
                data="dimes-templates",
                sun_elevation_deg=(30.0, 60.0),
                optical_depth=(0.6, 1.2),
                range_m=(1400.0, 2100.0),
            ),
        ),
    ),
)
