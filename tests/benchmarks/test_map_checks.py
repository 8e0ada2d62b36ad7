"""Tests of the comparison of images with maps: rectified images, and the values of flown images that it states."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.validation.image_statistics import compute_map_statistics
from benchmarks.validation.map_checks import FLOWN, HALF_FIELD_DEG, PIXEL_M, decimate_map, rectify, reduce_to_map
from marsyard.scenarios.localisation.camera import LanderCameraParameters, true_camera


def test_rectified_image_shows_directions_at_the_pixels_of_a_pinhole() -> None:
    """A dot in the fisheye image appears at the pinhole projection of its direction."""
    camera = true_camera(LanderCameraParameters())
    point = np.array([0.5, -0.3, -1.0])
    (u, v), _ = camera.project(point)
    y, x = np.mgrid[:1024, :1024]
    rectified = rectify(np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / 3.0**2), camera)
    row, column = np.unravel_index(rectified.argmax(), rectified.shape)
    focal_px = 0.5 * len(rectified) / np.tan(np.radians(HALF_FIELD_DEG))
    centre = 0.5 * (len(rectified) - 1)
    assert (column - centre, row - centre) == pytest.approx((0.5 * focal_px, 0.3 * focal_px), abs=1.0)
    height_m = 2000.0
    side = len(reduce_to_map(rectified, height_m))
    assert side * PIXEL_M == pytest.approx(2.0 * height_m * np.tan(np.radians(HALF_FIELD_DEG)), rel=0.01)


def _finest_amplitude(image: np.ndarray) -> float:
    """Return the amplitude of the spectrum near the Nyquist frequency, relative to the power law of lower ones."""
    side = 256
    window = np.outer(np.hanning(side), np.hanning(side))
    tiles = [
        image[row : row + side, column : column + side]
        for row in range(0, image.shape[0] - side + 1, side)
        for column in range(0, image.shape[1] - side + 1, side)
    ]
    power = np.sum([np.abs(np.fft.fft2((tile / tile.mean() - 1.0) * window)) ** 2 for tile in tiles], axis=0)
    frequency = np.fft.fftfreq(side)
    radius = np.hypot(frequency[:, None], frequency)
    edges = np.geomspace(0.03, 0.25, 9)
    rings = [(radius >= low) & (radius < high) for low, high in pairwise([*edges, 0.44, 0.5])]
    amplitude = np.log(np.sqrt([power[ring].mean() for ring in rings]))
    position = np.log([radius[ring].mean() for ring in rings])
    fit = np.polyfit(position[:8], amplitude[:8], 1)
    return float(np.exp(amplitude[-1] - np.polyval(fit, position[-1])))


def test_flown_map_is_reduced_without_an_average_and_so_are_maps_of_the_check(shared_data: Path) -> None:
    flown = cv2.imread(str(shared_data / "mars2020_lcam" / "jezero_map_small.jpg"), cv2.IMREAD_GRAYSCALE)
    assert flown is not None
    assert _finest_amplitude(flown[500:1780, 900:2048].astype(np.float64)) == pytest.approx(1.03, abs=0.03)
    # noise with amplitudes in proportion to frequency**-0.95, in pixels of 6 m
    side = 2048
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    modes = np.fft.rfft2(np.random.default_rng(1).standard_normal((side, side))) * frequency**-0.95
    fine = np.fft.irfft2(modes)
    fine = 1.0 + 0.1 * fine / fine.std()
    assert 1.0 < _finest_amplitude(decimate_map(fine, 6.0)) < 1.25
    average = cv2.resize(fine, (768, 768), interpolation=cv2.INTER_AREA)
    assert _finest_amplitude(average) < 0.9


def test_flown_frame_has_the_stated_yields_and_correlations(shared_data: Path) -> None:
    """Frame 34 of Mars 2020, about 3.5 km above Jezero (linear between 4 km and 1.2 km), on the map of 16 m a pixel."""
    folder = shared_data / "mars2020_lcam"
    frame = cv2.imread(str(folder / "frame_34.jpg"), cv2.IMREAD_GRAYSCALE)
    mapped = cv2.imread(str(folder / "jezero_map_small.jpg"), cv2.IMREAD_GRAYSCALE)
    assert frame is not None
    assert mapped is not None
    mapped = mapped[800:1568, 900:1668]
    camera = true_camera(LanderCameraParameters())
    image = reduce_to_map(rectify(cv2.resize(frame, (1024, 1024)), camera), 3490.0)
    statistics = compute_map_statistics(image, mapped.astype(np.float64))
    assert statistics is not None
    for name in ("sift", "orb", "correlation"):
        low, high = (float(value) for value in FLOWN[name].split(" to "))
        assert 0.95 * low <= getattr(statistics, name) <= 1.05 * high
    assert statistics.sift > statistics.orb
    assert statistics.strongest > statistics.correlation
