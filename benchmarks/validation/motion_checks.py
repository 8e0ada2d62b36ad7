"""Checks of the motion of rendered images: all sites from 2 km, and rocks from a mast."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.validation.estimators import PATCH
from benchmarks.validation.limits import find_limit
from benchmarks.validation.motion import STEPS_PX, Motion, View, measure, render, supersample
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import (
    DESCENT,
    FLOWN_CAMERA,
    MAST,
    descent_conditions,
    descent_view,
    renderer,
    rock_view,
    tile_view,
)
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.terrain.sites import sites

#: Limit of the control (bias of the estimator itself, `run_control`) with the option --quick: images of 16 samples per
#: pixel are less accurate than images of 256.
QUICK_CONTROL_LIMIT_PX = 0.005
DESCENT_HEIGHT_M = 2000.0
#: Height at which a pixel of the descent camera is 0.25 m; the orthoimage has 0.5 m.
TILE_HEIGHT_M = 300.0
#: Distances of the mast camera from a large rock.
DISTANCES_M = (10.0, 5.0, 2.0)
#: Distances at which the image contains the outline of the rock.
OUTLINE_DISTANCES_M = (10.0, 5.0)
ROCK_SITE = "gusev"
#: Elevation of the sun in all views.
SUN_DEG = 40.0
#: Size of descent images, with 256 patches of 31 x 31.
DESCENT_SIZE = (512, 512)
#: Size of control images (210 patches), and samples per pixel and axis (256 samples per pixel).
CONTROL_SIZE = (486, 455)
CONTROL_SAMPLES = 16
#: Steps of the control: maximum of pixel locking, and half a pixel.
CONTROL_STEPS_PX = np.array([0.25, 0.5])
#: Steps with the option --quick.
QUICK_STEPS_PX = np.array([0.3, 0.5, 0.8])


def max_bias(errors: Sequence[np.ndarray]) -> float:
    """Maximum mean error over both axes and all steps."""
    return float(max(np.abs(error.mean(axis=0)).max() for error in errors))


def max_standard_error(errors: Sequence[np.ndarray]) -> float:
    """Maximum standard error of the mean errors."""
    return float(max((error.std(axis=0, ddof=1) / np.sqrt(len(error))).max() for error in errors))


def _measure_bias(claim: str, errors: Sequence[np.ndarray], steps: np.ndarray, limit: float | None = None) -> Measure:
    """Measure a bias; the default limit is that of `limits`."""
    deviation = max(error.std(axis=0, ddof=1).max() for error in errors)
    patches = min(len(error) for error in errors)
    how = (
        f"{patches} patches, {len(steps)} steps from {steps[0]:.2g} to {steps[-1]:.2g} px; "
        f"standard deviation of one patch {deviation:.2g} px, of the mean {max_standard_error(errors):.1g} px"
    )
    return Measure(claim, max_bias(errors), "px", find_limit(claim) if limit is None else limit, how)


def _median_fit_errors(motions: Sequence[Motion]) -> tuple[float, float]:
    """Maximum median errors of parabola and quadric; medians, because parabolas have outliers."""
    return tuple(  # type: ignore[return-value]
        float(max(np.abs(np.median(getattr(motion, fit), axis=0)).max() for motion in motions))
        for fit in ("parabola", "biquadratic")
    )


def run_motion(quick: bool) -> Iterator[Measure]:
    """Measure the bias of image motion for all sites from 2 km and for rocks from a mast."""
    steps = QUICK_STEPS_PX if quick else STEPS_PX
    fits: list[tuple[float, float]] = []
    for name, site_parameters in sites().items():
        if site_parameters.descent is None:
            continue
        motions = list(measure(renderer(), descent_view(name, DESCENT_HEIGHT_M, DESCENT_SIZE), steps))
        fits.append(_median_fit_errors(motions))
        yield _measure_bias(f"bias of motion, {name} from 2 km", [motion.error for motion in motions], steps)
    for distance in DISTANCES_M:
        # overlapping patches at 10 m, because fewer than 200 separate patches fit onto the rock
        stride = 24 if distance > 5.0 else PATCH
        motions = list(measure(renderer(), rock_view(ROCK_SITE, distance), steps, stride=stride))
        fits.append(_median_fit_errors(motions))
        rock = _dominant_rock(motions[0])
        rock_errors = [motion.error[motion.body == rock] for motion in motions]
        yield _measure_bias(f"bias of motion, rock at {distance:g} m", rock_errors, steps)
        surrounding_errors = [motion.error[motion.body != rock] for motion in motions]
        if min(len(error) for error in surrounding_errors) >= 200:
            yield _measure_bias(
                f"bias of motion, ground at grazing view and rocks around the large rock, {distance:g} m",
                surrounding_errors,
                steps,
            )
    point_sample_view = replace(rock_view(ROCK_SITE, 10.0), footprint=1.0 / 64.0)
    errors = [motion.error for motion in measure(renderer(), point_sample_view, np.array([0.25, 0.5, 0.75]))]
    yield Measure(
        "bias of motion with point samples (aliasing), rock and ground from 10 m",
        max_bias(errors),
        "px",
        None,
        "3 steps",
    )
    for index, fit in enumerate(("parabola", "biquadratic")):
        max_error = max(fit_errors[index] for fit_errors in fits)
        yield Measure(
            f"pixel locking of a {fit} through the correlation peak", max_error, "px", None, "the same images"
        )


def run_tile(quick: bool) -> Iterator[Measure]:
    """Measure the bias of image motion over a measured HiRISE tile."""
    view = tile_view(TILE_HEIGHT_M, DESCENT_SIZE)
    if view is None:
        return
    steps = QUICK_STEPS_PX if quick else STEPS_PX
    errors = [motion.error for motion in measure(renderer(), view, steps)]
    yield _measure_bias(f"bias of motion, the HiRISE tile from {TILE_HEIGHT_M:g} m", errors, steps)


def _dominant_rock(motion: Motion) -> int:
    """Return the number of the rock with most patches."""
    rocks = motion.body[motion.body >= 0]
    return int(np.bincount(rocks).argmax())


def _control_views() -> Iterator[tuple[str, View]]:
    """Yield the views of the control by name."""
    yield "gusev from 2 km", descent_view("gusev", DESCENT_HEIGHT_M, CONTROL_SIZE)
    yield "rock at 5 m", rock_view(ROCK_SITE, 5.0, CONTROL_SIZE)


def run_control(quick: bool) -> Iterator[Measure]:
    """Measure the bias of the estimator itself, on images with many rays per pixel."""
    samples = 4 if quick else CONTROL_SAMPLES
    for name, view in _control_views():
        motions = list(measure(renderer(), view, CONTROL_STEPS_PX, samples))
        claim = f"bias of the estimator, {name}, {samples**2} samples per pixel"
        limit = QUICK_CONTROL_LIMIT_PX if quick else None
        yield _measure_bias(claim, [motion.error for motion in motions], CONTROL_STEPS_PX, limit)


def _measure_edge_error(view: View) -> tuple[float, float, int]:
    """Return the relative RMS error of radiance at edge pixels with one ray and with several, and their number.

    The reference has 256 rays per pixel, with ground and texture as smooth as in the pixel.
    """
    single_ray_view = replace(view, scene=replace(view.scene, edge_rays=1))
    one_ray, several_rays = render(renderer(), single_ray_view), render(renderer(), view)
    edges = np.flatnonzero(one_ray.radiance != several_rays.radiance)
    reference = supersample(renderer(), replace(single_ray_view, footprint=float(CONTROL_SAMPLES)), CONTROL_SAMPLES)
    one_ray_error, several_rays_error = (
        float(np.sqrt(np.mean((frame.radiance - reference).ravel()[edges] ** 2)) / reference.mean())
        for frame in (one_ray, several_rays)
    )
    return one_ray_error, several_rays_error, edges.size


def run_edges(quick: bool) -> Iterator[Measure]:
    """Measure the error of radiance at outlines against 256 rays per pixel."""
    size = (192, 160) if quick else (384, 320)
    for distance in OUTLINE_DISTANCES_M:
        full_view = rock_view(ROCK_SITE, distance)
        # the upper left part of the image contains an outline in front of distant ground
        view = replace(full_view, camera=full_view.camera.crop(0, 0, size))
        one_ray_error, several_rays_error, count = _measure_edge_error(view)
        yield Measure(
            f"radiance at outlines, rms, {distance:g} m from a rock",
            several_rays_error,
            "of the mean",
            None,
            f"{count} edge pixels, compared with 256 rays per pixel; with one ray per pixel {one_ray_error:.2g}",
        )


_ROCKS = Conditions(
    "*", MAST, site=(ROCK_SITE,), camera=("research-pancam",), sun_elevation_deg=(SUN_DEG, SUN_DEG), range_m=(2.0, 10.0)
)
CHECKS = (
    Check("edges", "Motion of images", run_edges, conditions=(replace(_ROCKS, range_m=(5.0, 10.0)),)),
    Check(
        "motion",
        "Motion of images",
        run_motion,
        conditions=(
            *(
                descent_conditions(f"*, {name} from 2 km", name, DESCENT_HEIGHT_M, SUN_DEG)
                for name in ("pisgah", "kelso", "ivanpah", "gusev", "meridiani")
            ),
            *(
                replace(_ROCKS, rows=f"*{rows}", range_m=(d, d))
                for rows, d in (("at 10 m", 10.0), ("large rock, 10 m", 10.0), ("at 5 m", 5.0), ("at 2 m", 2.0))
            ),
            _ROCKS,
        ),
    ),
    Check(
        "motion-tile",
        "Motion of images",
        run_tile,
        conditions=(
            Conditions(
                "*",
                DESCENT,
                site=("HiRISE tile in Gale",),
                camera=(FLOWN_CAMERA,),
                sun_elevation_deg=(SUN_DEG, SUN_DEG),
                range_m=(TILE_HEIGHT_M, TILE_HEIGHT_M),
            ),
        ),
    ),
    Check(
        "motion-control",
        "Motion of images",
        run_control,
        conditions=(
            descent_conditions("*gusev*", "gusev", DESCENT_HEIGHT_M, SUN_DEG),
            replace(_ROCKS, range_m=(5.0, 5.0)),
        ),
    ),
)
