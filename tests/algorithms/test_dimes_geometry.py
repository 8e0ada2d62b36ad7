"""Tests of the geometry of DIMES: projection between pixels and ground, template candidates and rectification."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.algorithms.dimes import ground_view, overlap, rectification
from marsyard.algorithms.dimes.ground_view import zero_phase_pixel
from marsyard.algorithms.dimes.options import DimesOptions
from marsyard.algorithms.dimes.views import BinnedView, build_view
from marsyard.sim.camera import Cahv
from marsyard.sim.frames import direction
from marsyard.sim.measurements import DetectorImage
from tests.algorithms.synthetic_descent import (
    CAMERA,
    INTERVAL_S,
    ROWS_SUMMED,
    Texture,
    draw_terrain,
    expose_scene,
    make_calibration,
    tilt_body,
    trace_scene,
)

OPTIONS = DimesOptions()
MAX_OFF_NADIR_RAD = OPTIONS.max_off_nadir_rad
#: Without sunlight there is no zero-phase spot (opposition surge) on the ground.
SUN_BELOW_HORIZON = direction(0.0, -1.0)


def make_view(
    attitude: Rotation,
    altitude_m: float,
    time_s: float = 0.0,
    counts: np.ndarray | None = None,
    sun: np.ndarray = SUN_BELOW_HORIZON,
) -> BinnedView:
    """Create a view of level ground; its image is uniform unless `counts` are given."""
    image = np.full((256, 1024), 1000, dtype=np.uint16) if counts is None else counts
    detector_image = DetectorImage(image, time_s, CAMERA.bin(1, ROWS_SUMMED), make_calibration())
    return build_view(detector_image, attitude, altitude_m, sun, (256, 256))


def make_views(
    first: Rotation, second: Rotation, altitudes: tuple[float, float] = (2000.0, 1719.0)
) -> tuple[BinnedView, BinnedView]:
    """Create two views with these attitudes; the default altitudes differ by 75 m/s in 3.75 s."""
    return make_view(first, altitudes[0]), make_view(second, altitudes[1], INTERVAL_S)


def find_candidates(first: BinnedView, second: BinnedView, sun: np.ndarray = SUN_BELOW_HORIZON) -> overlap.Candidates:
    """Find the template candidates of a pair."""
    first, second = (replace(view, sun_direction=sun) for view in (first, second))
    return overlap.template_candidates(first, second, overlap.search_geometry(first, second, OPTIONS), OPTIONS)


def test_distant_rays_are_clipped_at_the_off_nadir_limit() -> None:
    view = make_view(tilt_body(80.0, 0.0, 0.0), 1500.0)  # tilted: half of the image is sky
    pixels = overlap.border_pixels(view.size)
    ground, is_within_limit = ground_view.ground_from_pixels(view, pixels, MAX_OFF_NADIR_RAD)
    _, directions = view.camera.rays(pixels)
    assert np.any(directions[:, 2] > 0.0)
    assert not is_within_limit.all()
    off_nadir = np.hypot(*ground.T) / view.centre[2]
    np.testing.assert_allclose(off_nadir[~is_within_limit], np.tan(MAX_OFF_NADIR_RAD))
    dot_products = np.sum(ground * directions[:, :2], axis=1)
    np.testing.assert_allclose(dot_products, np.hypot(*ground.T) * np.hypot(*directions[:, :2].T))


def test_camera_is_above_origin_for_any_mounting_position() -> None:
    attitude = tilt_body(30.0, 45.0, 10.0)
    lever_arm_m = np.array([0.5, -1.0, -2.0])
    camera = CAMERA.bin(1, ROWS_SUMMED).transform(RigidTransform.from_translation(lever_arm_m))
    image = DetectorImage(np.zeros((256, 1024), dtype=np.uint16), 0.0, camera, make_calibration())
    view = build_view(image, attitude, 1400.0, SUN_BELOW_HORIZON, (256, 256))
    np.testing.assert_allclose(view.camera.c, view.centre, atol=1e-9)
    np.testing.assert_allclose(view.centre, [0.0, 0.0, 1400.0 + attitude.apply(lever_arm_m)[2]], atol=1e-9)


def test_pixel_angle_and_search_geometry_match_the_paper() -> None:
    first, second = make_views(Rotation.identity(), Rotation.identity())
    # 4 x 12 um / 14.67 mm = 3.272 mrad; distortion changes it by less than 0.1 % near the image centre.
    assert second.camera.pixel_angle_rad == pytest.approx(4 * 12e-6 / 0.01467, rel=2e-3)
    geometry = overlap.search_geometry(first, second, OPTIONS)
    assert geometry.gsd_m == pytest.approx(1719.0 * 3.272e-3, rel=2e-3)
    # 30 m/s in 3.75 s: 112.5 m (the paper's "at least 110 m") are 20.003 px, rounded up to 21, plus the margin.
    assert geometry.search_px == 21 + OPTIONS.search_margin_px
    assert geometry.window_px == OPTIONS.template_px + 2 * geometry.search_px


def test_nadir_overlap_is_the_smaller_image() -> None:
    first, second = make_views(Rotation.identity(), Rotation.identity())
    polygon = overlap.overlap_polygon(first, second, OPTIONS)
    # The second image is taken from 1719 m, the first from 2000 m: without distortion the border of the second image,
    # seen in the first, is at 1719 / 2000 = 0.8595 of its distance from the principal point.
    principal_point = np.array([(515.0 - 1.5) / 4, (508.5 - 1.5) / 4])
    expected = principal_point + (overlap.border_pixels(second.size) - principal_point) * 0.8595
    np.testing.assert_allclose(polygon, expected, atol=1.2)


def test_candidates_lie_within_the_overlap_polygon() -> None:
    first, second = make_views(tilt_body(15.0, 10.0, 0.0), tilt_body(12.0, 120.0, 77.0))
    polygon = overlap.overlap_polygon(first, second, OPTIONS).astype(np.float32)
    positions = find_candidates(first, second).pixels
    assert len(positions) > 20
    border_distances = [cv2.pointPolygonTest(polygon, (float(u), float(v)), True) for u, v in positions]
    # A template's centre can be at the border of the second image; 1 px for the arcs between the polygon's corners.
    assert min(border_distances) > -1.0


@pytest.mark.slow
def test_each_candidate_fits_template_and_each_preferred_one_its_window() -> None:
    rng = np.random.default_rng(8)
    for _ in range(6):
        attitudes = [tilt_body(*rng.uniform([0.0, 0.0, 0.0], [25.0, 360.0, 360.0])) for _ in range(2)]
        first, second = make_views(attitudes[0], attitudes[1])
        geometry = overlap.search_geometry(first, second, OPTIONS)
        candidates = find_candidates(first, second)
        assert set(candidates.preference) >= {0, 1, 3}
        for ground, preference in zip(candidates.ground, candidates.preference, strict=True):
            assert ground_view.inside_frame(
                first, ground + ground_view.square_outline(geometry.template_half_m, 15), 0.0, MAX_OFF_NADIR_RAD
            ).all()
            halves = (geometry.template_half_m, geometry.window_half_m, geometry.window_half_m)[:preference]
            for half in halves:
                assert ground_view.inside_frame(
                    second, ground + ground_view.square_outline(half, 15), 0.0, MAX_OFF_NADIR_RAD
                ).all()
            if preference >= 2:
                assert overlap.searchable_positions(second, ground, geometry, OPTIONS).all()


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (tilt_body(0.0, 0.0, 0.0), tilt_body(120.0, 0.0, 0.0)),  # the second image shows the sky
        (tilt_body(180.0, 0.0, 0.0), tilt_body(0.0, 0.0, 0.0)),  # the first image shows the sky
        (tilt_body(35.0, 0.0, 0.0), tilt_body(35.0, 180.0, 0.0)),  # opposite directions
    ],
)
def test_images_without_overlap_have_no_candidates(first: Rotation, second: Rotation) -> None:
    assert len(find_candidates(*make_views(first, second)).pixels) == 0


#: Views that tilt by 19 deg to opposite sides.
TILTED_APART = (tilt_body(19.0, 0.0, 0.0), tilt_body(19.0, 180.0, 0.0))


def test_overlap_width_is_that_of_the_strip_between_opposite_views() -> None:
    # Both images tilt by t to opposite sides (in east): the strip ends at h1 tan(a - t) and h2 tan(a - t), with the
    # half field of view a. Distortion and the off-centre principal point change it by a few per cent.
    first, second = make_views(*TILTED_APART)
    gsd_m = overlap.search_geometry(first, second, OPTIONS).gsd_m
    half_field = np.arctan(0.5 * 1024 * 12e-6 / 0.01467)
    expected = (2000.0 + 1719.0) * np.tan(half_field - np.radians(19.0))
    width = overlap.overlap_width_m(first, second, gsd_m, OPTIONS)
    # the grid changes the distance to each of both sides by up to a cell
    assert width == pytest.approx(expected, abs=2.0 * gsd_m + 0.05 * expected)
    apart = make_views(tilt_body(35.0, 0.0, 0.0), tilt_body(35.0, 180.0, 0.0))
    assert overlap.overlap_width_m(*apart, gsd_m, OPTIONS) == 0.0


def test_overlap_must_be_as_wide_as_the_largest_displacement() -> None:
    """The search window of 2 x 25 + 31 px, 456 m, is wider than the overlap of about 240 m."""
    views = make_views(*TILTED_APART)
    candidates = find_candidates(*views)
    assert len(candidates.pixels) > 0
    assert candidates.preference.max() == 1
    # 30 m/s in 3.75 s are 112.5 m, 80 m/s are 300 m
    options = replace(OPTIONS, max_speed_m_s=80.0)
    geometry = overlap.search_geometry(*views, options)
    assert geometry.max_displacement_m == pytest.approx(300.0)
    assert len(overlap.template_candidates(*views, geometry, options).pixels) == 0


def test_searchable_positions_show_the_complete_template() -> None:
    first, second = make_views(Rotation.identity(), Rotation.identity())
    geometry = overlap.search_geometry(first, second, OPTIONS)
    centre, _ = ground_view.ground_from_pixels(second, np.array([[250.0, 128.0]]), MAX_OFF_NADIR_RAD)
    searchable = overlap.searchable_positions(second, centre[0], geometry, OPTIONS)[::4, ::4]
    # every fourth position
    offsets = geometry.gsd_m * (np.arange(2 * geometry.search_px + 1)[::4] - geometry.search_px)
    half = 0.5 * (OPTIONS.template_px - 1) * geometry.gsd_m
    expected = [
        [
            ground_view.inside_frame(
                second, centre[0] + [east, -south] + ground_view.square_outline(half, 9), 3.0, MAX_OFF_NADIR_RAD
            ).all()
            for east in offsets
        ]
        for south in offsets
    ]
    np.testing.assert_array_equal(searchable, expected)
    assert 0 < searchable.sum() < searchable.size


def test_zero_phase_pixel_is_at_the_lander_shadow() -> None:
    # The sun is in the east, 60 deg high: the shadow is in the west, at altitude / tan 60 from the nadir.
    sun = direction(np.radians(90.0), np.radians(60.0))
    view = make_view(tilt_body(10.0, 200.0, 30.0), 2000.0, sun=sun)
    shadow = np.array([[-2000.0 / np.tan(np.radians(60.0)), 0.0]])
    # A direction and a ground point along it project to the same pixel, except for rounding at distances of 1e7 m.
    np.testing.assert_allclose(zero_phase_pixel(view), ground_view.pixels_from_ground(view, shadow)[0][0], atol=1e-3)
    assert np.all(np.isnan(zero_phase_pixel(replace(view, sun_direction=-sun))))


def test_templates_and_windows_avoid_zero_phase_spot() -> None:
    """All templates are outside of the spot. A candidate is preferred if its whole search window is also outside."""
    radius = OPTIONS.zero_phase_radius_rad
    for azimuth in np.radians([0.0, 100.0, 230.0]):
        sun = direction(azimuth, np.radians(80.0))
        first, second = make_views(tilt_body(5.0, 30.0, 0.0), tilt_body(8.0, 60.0, 140.0))
        geometry = overlap.search_geometry(first, second, OPTIONS)
        candidates = find_candidates(first, second, sun)
        candidates_without_spot = find_candidates(first, second)
        assert 0 < len(candidates.pixels) < len(candidates_without_spot.pixels)
        preferred = candidates.preference == 3
        assert 0 < preferred.sum() < len(candidates.pixels)
        for view in (first, second):
            for ground, is_preferred in zip(candidates.ground, preferred, strict=True):
                half = geometry.window_half_m if is_preferred and view is second else geometry.template_half_m
                points = np.column_stack([ground + ground_view.square_lattice(half, 25), np.zeros(625)]) - view.centre
                cosines = points @ -sun / np.linalg.norm(points, axis=1)
                # Between lattice points the spot may extend into the window by a fraction of a degree.
                assert np.degrees(np.arccos(cosines.max())) > np.degrees(radius) - 0.6
        selected, _ = overlap.select_templates(first, candidates, OPTIONS)
        assert all(preferred[k] for k in selected)


def test_grid_has_the_given_step_and_is_centred() -> None:
    pixels = overlap.grid_pixels((256, 256), 8)
    assert pixels.shape == (32 * 32, 2)
    assert pixels.min() == 3.0
    assert pixels.max() == 251.0


def test_candidates_with_highest_contrast_are_selected_with_min_spacing() -> None:
    pixels = np.array([[10.0, 10.0], [20.0, 12.0], [60.0, 10.0], [10.0, 90.0]])
    contrasts = np.array([0.9, 0.8, 0.1, 0.5])
    equal = np.ones(4, dtype=int)
    assert overlap.best_candidates(contrasts, pixels, equal, 2, 31.0) == [0, 3]
    assert overlap.best_candidates(contrasts, pixels, equal, 4, 31.0) == [0, 3, 2]
    assert overlap.best_candidates(contrasts, pixels, equal, 2, 5.0) == [0, 1]
    # A candidate at exactly the minimum spacing is available.
    assert overlap.best_candidates(contrasts, pixels, equal, 2, 10.0) == [0, 1]
    assert overlap.best_candidates(contrasts, pixels, np.array([0, 1, 0, 0]), 2, 31.0) == [1, 3]
    assert overlap.best_candidates(contrasts, pixels, np.array([0, 0, 2, 1]), 3, 31.0) == [2, 3, 0]
    assert overlap.best_candidates(np.zeros(0), np.zeros((0, 2)), np.zeros(0, dtype=int), 2, 31.0) == []


def test_first_selected_template_is_in_the_textured_area() -> None:
    counts = np.full((256, 1024), 1000, dtype=np.uint16)
    rng = np.random.default_rng(6)
    counts[140:170, 4 * 60 : 4 * 90] = np.repeat(rng.integers(700, 1300, (30, 30), dtype=np.uint16), 4, axis=1)
    view = make_view(Rotation.identity(), 2000.0, 0.0, counts)
    pixels = overlap.grid_pixels(view.size, OPTIONS.grid_step_px)
    candidates = overlap.Candidates(pixels, pixels, np.ones(len(pixels), dtype=int))
    selected_numbers, contrasts = overlap.select_templates(view, candidates, OPTIONS)
    np.testing.assert_allclose(pixels[selected_numbers[0]], [75.0, 155.0], atol=OPTIONS.grid_step_px)
    assert contrasts[0] > 0.02
    assert contrasts[1] < 0.001
    assert overlap.template_contrasts(view, pixels, OPTIONS.template_px)[selected_numbers[0]] == contrasts[0]


def test_patch_across_the_border_repeats_the_border_pixels() -> None:
    attitude, position = tilt_body(0.0, 0.0, 0.0), np.array([0.0, 0.0, 1700.0])
    counts = expose_scene(trace_scene(draw_terrain(), attitude, position), make_calibration(), level=1600.0)
    view = make_view(attitude, 1700.0, 0.0, counts)
    columns, rows = view.size
    corner, _ = ground_view.ground_from_pixels(view, np.array([[columns - 1.0, rows - 1.0]]), MAX_OFF_NADIR_RAD)
    patch = rectification.rectify_patch(view, corner[0], 21, 5.5)
    pixels, _ = ground_view.pixels_from_ground(view, rectification.ground_lattice(corner[0], 21, 5.5))
    is_outside = (pixels > np.array([columns - 1.0, rows - 1.0])).all(axis=-1)
    assert np.count_nonzero(is_outside) > 50
    image = rectification.correct_patch(view, np.s_[:], np.s_[:])
    np.testing.assert_allclose(patch[is_outside], image[-1, -1], rtol=1e-12)


def test_homography_neglects_only_the_distortion_within_a_patch() -> None:
    view = make_view(tilt_body(20.0, 70.0, 200.0), 1850.0)
    lattice = rectification.ground_lattice(np.array([-150.0, 200.0]), 31, 5.5)
    exact_pixels, is_visible_exactly = ground_view.pixels_from_ground(view, lattice)
    pixels, is_visible = rectification.homography_lattice(view, lattice)
    assert is_visible_exactly.all()
    assert is_visible.all()
    corners = ([0, 0, -1, -1], [0, -1, 0, -1])
    np.testing.assert_allclose(pixels[corners], exact_pixels[corners], atol=1e-4)
    differences_px = np.hypot(*np.moveaxis(pixels - exact_pixels, -1, 0))
    # 31 px span a seventh of the image; the lens shifts its corners by 5 % of a pixel more than its centre.
    assert 1e-4 < differences_px.max() < 0.1
    pinhole = replace(view, camera=Cahv(view.camera.c, view.camera.a, view.camera.h, view.camera.v, view.camera.size))
    np.testing.assert_allclose(
        rectification.homography_lattice(pinhole, lattice)[0],
        ground_view.pixels_from_ground(pinhole, lattice)[0],
        atol=2e-4,
    )


def test_homography_of_an_invisible_corner_is_invisible() -> None:
    view = make_view(tilt_body(75.0, 0.0, 0.0), 1500.0)
    lattice = rectification.ground_lattice(np.array([0.0, -40000.0]), 5, 5.5)
    _, is_visible = rectification.homography_lattice(view, lattice)
    assert not is_visible.any()


def test_ground_lattice_is_north_up() -> None:
    lattice = rectification.ground_lattice(np.array([100.0, 200.0]), 3, 10.0)
    np.testing.assert_allclose(lattice[0, 0], [90.0, 210.0])
    np.testing.assert_allclose(lattice[2, 1], [100.0, 190.0])


def _estimate_shift(patch: np.ndarray, expected: np.ndarray, lattice: np.ndarray) -> np.ndarray:
    """Estimate the displacement (east, north) of a patch from the expected one, metres, by one least-squares step."""
    east, north = lattice[..., 0], lattice[..., 1]
    slopes = [
        (wave_brightness(east + dx, north + dy) - wave_brightness(east - dx, north - dy)) / 0.2
        for dx, dy in ((0.1, 0.0), (0.0, 0.1))
    ]
    design = np.column_stack([slopes[0].ravel(), slopes[1].ravel(), np.ones(patch.size)])
    solution, *_ = np.linalg.lstsq(design, (patch - expected).ravel())
    return np.asarray(solution[:2])


def make_wave_texture() -> Texture:
    """Create a texture with the analytic brightness `wave_brightness`: waves of 60 to 200 m."""
    offsets_m = 1.5 * np.arange(2048)
    return Texture(wave_brightness(offsets_m[None, :], -offsets_m[:, None]).astype(np.float32), 1.5)


def wave_brightness(east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    east, north = (2.0 * np.pi * x / (2048 * 1.5) for x in (east_m, north_m))
    return 1.0 + 0.2 * np.sin(30 * east + 0.4) * np.cos(17 * north) + 0.2 * np.cos(41 * north - 12 * east)


def test_ground_and_pixel_projections_are_inverse() -> None:
    view = make_view(tilt_body(20.0, 70.0, 200.0), 1850.0)
    pixels = overlap.grid_pixels(view.size, 16)
    ground, is_within_limit = ground_view.ground_from_pixels(view, pixels, MAX_OFF_NADIR_RAD)
    projections, visible = ground_view.pixels_from_ground(view, ground)
    assert is_within_limit.sum() > 200
    assert np.all(visible[is_within_limit])
    np.testing.assert_allclose(projections[is_within_limit], pixels[is_within_limit], atol=1e-6)


@pytest.mark.parametrize(
    "attitude", [tilt_body(0.0, 0.0, 0.0), tilt_body(18.0, 200.0, 140.0), tilt_body(25.0, 80.0, 300.0)]
)
def test_rectified_patch_shows_its_lattice_positions(attitude: Rotation) -> None:
    position = np.array([700.0, -300.0, 1700.0])
    counts = expose_scene(trace_scene(make_wave_texture(), attitude, position), make_calibration(), level=1600.0)
    view = make_view(attitude, 1700.0, 0.0, counts)
    centre, is_within_limit = ground_view.ground_from_pixels(view, np.array([[150.0, 90.0]]), MAX_OFF_NADIR_RAD)
    assert is_within_limit[0]
    patch = rectification.rectify_patch(view, centre[0], 61, 5.5)
    lattice = rectification.ground_lattice(centre[0], 61, 5.5) + position[:2]
    expected = wave_brightness(lattice[..., 0], lattice[..., 1])
    shift = _estimate_shift(patch / 1600.0, expected, lattice)
    # 0.01 of a binned pixel: 0.06 m, or 0.015 m/s over 3.75 s.
    assert np.abs(shift).max() < 0.06
    np.testing.assert_allclose(patch / 1600.0, expected, atol=0.02)
