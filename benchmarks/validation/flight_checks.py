"""Checks of the world against flight: statistics of rendered pictures next to those of pictures from Mars.

The bounds are those of Spirit's descent pictures (public copies, 843 pixels), HiRISE orthoimages, and both rovers' mast
pictures. Terrains whose figures are fitted to them are no predictions (`sim/terrain/sites.toml` says which).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import marsyard
from benchmarks.validation.records import Check, Measure
from marsyard.algorithms.dimes.details import TRACK_COLUMNS
from marsyard.cli.pictures import ImageRequest, render_images
from marsyard.sim.image_statistics import ImageStatistics, compute_image_statistics

#: Altitudes of two of Spirit's descent pictures, metres.
ALTITUDES_M = (1433.0, 1983.0)
#: Azimuths and elevation of mast pictures, degrees: like the flown ones, without the horizon.
AZIMUTHS_DEG, ELEVATION_DEG = (0.0, 90.0, 180.0, 270.0), -35.0


def _measure(site: str, camera: str, **settings: float | int) -> ImageStatistics:
    image = render_images(ImageRequest.from_defaults(site, camera, **settings), both=False)[0]
    return compute_image_statistics(image.to_uint16().astype(np.float64))


def run_descent(quick: bool) -> Iterator[Measure]:
    """Compare descent pictures over Gusev and Meridiani with Spirit's."""
    for site in ("gusev", "meridiani"):
        seeds = range(1, 4 if quick else 21)
        rows = [
            _measure(site, "mer-descent-flown", altitude_m=altitude, seed=seed)
            for seed in seeds
            for altitude in ALTITUDES_M
        ]
        middle = ImageStatistics(*np.median(rows, axis=0))
        spread = np.diff(np.percentile([row.patchiness for row in rows], [10.0, 90.0]))
        how, name = f"median of {len(rows)} pictures of {len(seeds)} terrains", f"descent over {site}"
        yield Measure(f"patchiness, {name}", middle.patchiness, "", 2.6, f"{how}; Spirit: 2.83 to 3.00", "at least")
        yield Measure(f"patchiness, {name}, upper bound", middle.patchiness, "", 3.3, f"{how}; HiRISE: 2.67 to 3.31")
        yield Measure(f"10 to 90 % range of patchiness, {name}", float(spread[0]), "", 0.5, how, "at least")
        yield Measure(f"slope of the spectrum, {name}", middle.slope, "", -2.0, f"{how}; Spirit: -2.24 to -2.94")
        claim = f"slope of the spectrum, {name}, lower bound"
        yield Measure(claim, middle.slope, "", -2.9, how, "at least")
        claim = f"contrast of the smoothest tenth, {name}"
        yield Measure(claim, middle.local_p10, "", 0.042, f"{how}; Spirit: 0.036 to 0.038")
        yield Measure(f"corners over centre, {name}", middle.corner, "", None, f"{how}; cos^4 of the lens, see docs")


def run_mast(quick: bool) -> Iterator[Measure]:
    """Compare mast pictures with those of both rovers."""
    for site, flown in (("gusev", "Spirit: 0.061 to 0.065"), ("meridiani", "Opportunity: 0.046 to 0.055")):
        seeds = range(1, 2 if quick else 6)
        rows = [
            _measure(site, "mer-navcam", azimuth_deg=azimuth, elevation_deg=ELEVATION_DEG, seed=seed)
            for seed in seeds
            for azimuth in AZIMUTHS_DEG
        ]
        contrast = float(np.median([row.local_p50 for row in rows]))
        how = f"median of {len(rows)} pictures of {len(seeds)} terrains; {flown}"
        claim = f"contrast of blocks of mast pictures, {site}"
        yield Measure(claim, contrast, "", 0.045, how, "at least")
        yield Measure(f"{claim}, upper bound", contrast, "", 0.075, how)


#: Extremes over the four DIMES templates of Spirit's descent images: peak width, px, and second peak over first peak.
FLOWN_WIDTHS_PX, FLOWN_SECOND_PEAKS = (3.3, 15.6), (0.40, 0.82)
#: 95 % interval of the fraction of refused templates by Clopper and Pearson: one of four was refused.
FLOWN_REFUSED = (0.006, 0.806)


def run_templates(quick: bool) -> Iterator[Measure]:
    """Compare the correlation peaks of DIMES' templates in `dimes-gusev` with those of the four flown templates."""
    campaign = marsyard.load_campaign("dimes-gusev", {"location.bank": 8})
    products = [marsyard.run_case(campaign, case).products for case in range(1, 4 if quick else 41)]
    tracks = np.concatenate([product["tracks"] for product in products if "tracks" in product])
    width, second, valid = (
        tracks[:, TRACK_COLUMNS.index(name)] for name in ("peak_width", "second_peak_ratio", "valid")
    )
    how = f"{len(tracks)} templates of {len(products)} cases of dimes-gusev; Spirit: four templates"
    for name, values, (low, high) in (
        ("width of the correlation peak, px", width, FLOWN_WIDTHS_PX),
        ("second peak over first peak", second, FLOWN_SECOND_PEAKS),
    ):
        low_5, middle, high_95 = np.percentile(values, (5.0, 50.0, 95.0))
        text = f"{how}; median {middle:.2g}, 5 to 95 % {low_5:.2g} to {high_95:.2g}"
        yield Measure(f"{name}: smallest", float(values.min()), "", low, text)
        yield Measure(f"{name}: largest", float(values.max()), "", high, text, "at least")
    refused = float(np.mean(valid == 0.0))
    yield Measure("refused templates", refused, "", FLOWN_REFUSED[1], f"{how}, one refused")
    yield Measure("refused templates, lower bound", refused, "", FLOWN_REFUSED[0], f"{how}, one refused", "at least")


CHECKS = (
    Check("flight", "The world against pictures from Mars: descents", run_descent),
    Check("flight-templates", "The world against pictures from Mars: templates of DIMES", run_templates),
    Check("flight-mast", "The world against pictures from Mars: masts", run_mast),
)
