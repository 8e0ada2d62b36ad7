"""Tests of projection and rays: inversion, the scalar reference formulas, Jacobians and invisible points."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel

# ----- random cameras -----


@st.composite
def cahv_cameras(draw: st.DrawFn) -> Cahv:
    attitude = Rotation.from_rotvec(draw(arrays(float, 3, elements=st.floats(-3, 3)))).as_matrix()
    size = draw(st.tuples(st.integers(2, 2048), st.integers(2, 2048)))
    return Cahv.from_field_of_view(
        draw(st.floats(0.05, 1.8)),
        size,
        vertical_rad=draw(st.floats(0.05, 1.8)),
        axis=attitude[:, 0],
        right=attitude[:, 1],
        centre=draw(arrays(float, 3, elements=st.floats(-5000, 5000))),
    )


def tilt_axis(axis: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Add a small vector to an axis and normalise the sum."""
    tilted = axis + tilt
    return np.asarray(tilted / np.linalg.norm(tilted))


axis_tilts = arrays(float, 3, elements=st.floats(-0.03, 0.03))
radial_coefficients = st.tuples(st.floats(-0.05, 0.05), st.floats(-0.08, 0.2), st.floats(-0.02, 0.05)).map(np.array)


@st.composite
def cahvor_cameras(draw: st.DrawFn) -> Cahvor:
    cahv = draw(cahv_cameras())
    return Cahvor.from_cahv(cahv, r=draw(radial_coefficients), o=tilt_axis(cahv.a, draw(axis_tilts)))


@st.composite
def cahvore_cameras(draw: st.DrawFn) -> Cahvore:
    cahv = draw(cahv_cameras())
    return Cahvore.from_cahv(
        cahv,
        r=draw(radial_coefficients),
        e=draw(arrays(float, 3, elements=st.floats(-0.003, 0.003))),
        linearity=draw(st.sampled_from([-1.0, -0.5, 0.0, 0.37, 1.0]) | st.floats(-1, 1)),
        o=tilt_axis(cahv.a, draw(axis_tilts)),
    )


cameras = st.one_of(cahv_cameras(), cahvor_cameras(), cahvore_cameras())
fractions = arrays(float, (4, 2), elements=st.floats(0, 1))


def pixels_from_fractions(camera: CameraModel, uv: np.ndarray) -> np.ndarray:
    """Return the pixels at fractions `uv` (0 to 1) of the frame width and height, shape (n, 2)."""
    return np.asarray(uv * np.array(camera.size) - 0.5)


# ----- projection and rays are inverse -----


def test_projection_inverts_rays_of_real_cameras(camera: CameraModel) -> None:
    pixels = camera.pixel_grid()[::3, ::3]
    origins, directions = camera.rays(pixels)
    for distance_m in (0.5, 10.0, 1e4):
        reprojected, visible = camera.project(origins + distance_m * directions)
        assert visible.all()
        # The requirement is 1e-8 px for CAHVOR and 1e-3 px for CAHVORE. Newton's method converges to rounding errors:
        # about 1e3 * 2e-16 * 1e4 / 10 ~ 2e-12 px for pixels near 1000 and points near 1e4 m.
        assert np.max(np.abs(reprojected - pixels)) < 1e-10


@given(cameras, fractions, st.floats(0.5, 1e5))
def test_projection_inverts_rays_of_random_cameras(camera: CameraModel, uv: np.ndarray, distance_m: float) -> None:
    pixels = pixels_from_fractions(camera, uv)
    origins, directions = camera.rays(pixels)
    has_ray = np.isfinite(directions).all(axis=-1)
    reprojected, visible = camera.project(origins + distance_m * directions)
    assert np.array_equal(visible, has_ray)
    assert np.allclose(np.linalg.norm(directions[has_ray], axis=-1), 1, rtol=0, atol=4e-15)
    # C is up to 5000 m away: a point at 0.5 m is rounded by 1e-12 m, or 1e-7 px for 4e4 px/rad (2048 px in 0.05 rad).
    # Near the end of the polynomial's range the inverse direction loses digits, but the pixel does not.
    assert np.max(np.abs(reprojected - pixels)[has_ray], initial=0) < 1e-6


def test_rays_of_cahvore_start_on_the_optical_axis(hazcam: Cahvore) -> None:
    origins, _ = hazcam.rays(hazcam.pixel_grid()[::64, ::64])
    shift = origins - hazcam.c
    axis_distance = shift @ hazcam.o
    # The length of O is 1 within 1e-6, as labelled; the largest shift is about 10 mm.
    assert np.allclose(shift, axis_distance[..., np.newaxis] * hazcam.o, atol=2e-8)
    assert axis_distance.max() > 1e-3


# ----- reference: scalar translation of JPL's cmod -----


def project_with_cmod_cahvor(camera: Cahvor, point: np.ndarray) -> tuple[float, float]:
    """Project a point as cmod_cahvor_3d_to_2d does, with Gennery's symbols omega, lambda, tau and mu."""
    difference = point - camera.c
    omega = difference @ camera.o
    lambda_ = difference - omega * camera.o
    tau = (lambda_ @ lambda_) / (omega * omega)
    mu = camera.r[0] + camera.r[1] * tau + camera.r[2] * tau * tau
    distorted = difference + mu * lambda_
    alpha, beta, gamma = distorted @ camera.a, distorted @ camera.h, distorted @ camera.v
    return beta / alpha, gamma / alpha


def project_with_cmod_cahvore(camera: Cahvore, point: np.ndarray) -> tuple[float, float]:
    """Project a point as cmod_cahvore_3d_to_2d_general does, with Gennery's symbols and Newton's method for theta.

    The iteration ends after a step below 1e-8.
    """
    difference = point - camera.c
    zeta = float(difference @ camera.o)
    lambda3 = difference - zeta * camera.o
    lambda_ = math.sqrt(lambda3 @ lambda3)
    e0, e1, e2 = camera.e.tolist()
    theta = math.atan2(lambda_, zeta)
    step = 1.0
    for _ in range(100):
        cosine, sine = math.cos(theta), math.sin(theta)
        series = e0 + e1 * theta**2 + e2 * theta**4
        upsilon = (
            zeta * cosine
            + lambda_ * sine
            - (1 - cosine) * series
            - (theta - sine) * (2 * e1 * theta + 4 * e2 * theta**3)
        )
        if abs(step) < 1e-8:
            break
        step = (zeta * sine - lambda_ * cosine - (theta - sine) * series) / upsilon
        theta -= step
    if theta < 1e-8:
        distorted = difference
    else:
        linear = camera.linearity * theta
        if camera.linearity < -1e-15:
            chi = math.sin(linear) / camera.linearity
        elif camera.linearity > 1e-15:
            chi = math.tan(linear) / camera.linearity
        else:
            chi = theta
        mu = camera.r[0] + camera.r[1] * chi**2 + camera.r[2] * chi**4
        distorted = lambda_ / chi * camera.o + (1 + mu) * lambda3
    alpha, beta, gamma = distorted @ camera.a, distorted @ camera.h, distorted @ camera.v
    return beta / alpha, gamma / alpha


@settings(max_examples=50)
@given(st.one_of(cahvor_cameras(), cahvore_cameras()), fractions, st.floats(1, 1e4))
def test_projection_matches_cmod(camera: Cahvor | Cahvore, uv: np.ndarray, distance_m: float) -> None:
    origins, directions = camera.rays(pixels_from_fractions(camera, uv))
    points = (origins + distance_m * directions)[np.isfinite(directions).all(axis=-1)]
    project = project_with_cmod_cahvor if isinstance(camera, Cahvor) else project_with_cmod_cahvore
    expected = np.array([project(camera, point) for point in points]).reshape(-1, 2)  # type: ignore[arg-type]
    # The bound is the rounding of points 5000 m away.
    assert np.max(np.abs(camera.project(points)[0] - expected), initial=0) < 1e-6


# ----- limits -----


def test_points_behind_the_camera_are_not_visible(camera: CameraModel) -> None:
    behind = camera.c - 5 * camera.a + np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    pixels, visible = camera.project(behind)
    assert not visible.any()
    assert np.isnan(pixels).all()
    assert np.isnan(camera.projection_jacobian(behind)).all()
    assert not camera.in_frame(pixels).any()


def test_projection_centre_and_nan_are_not_visible(camera: CameraModel) -> None:
    points = np.array([camera.c, [np.nan, 0, 0], [np.inf, 0, 0]])
    assert not camera.project(points)[1].any()


def test_pixels_beyond_distortion_range_have_no_ray() -> None:
    """The distortion chi - 0.2 chi^3 has its maximum, (2 / 3) sqrt(1 / 0.6), at chi^2 = 1 / 0.6."""
    cahv = Cahv.from_axes((100.0, 100.0), (400, 400), axis=(0, 0, 1), right=(1, 0, 0))
    camera = Cahvor.from_cahv(cahv, r=(0.0, -0.2, 0.0))
    hc, vc = camera.image_centre
    max_radius_px = 100 * 2 / 3 * math.sqrt(1 / 0.6)
    directions = camera.rays(np.array([[hc + 0.9999 * max_radius_px, vc], [hc + 1.0001 * max_radius_px, vc]]))[1]
    assert np.isfinite(directions[0]).all()
    assert np.isnan(directions[1]).all()


@pytest.mark.parametrize(
    "r", [(0.0, -0.2, 0.0), (0.0, 0.3, -0.05), (0.0, -0.3, 0.06), (-0.5, 0.0, 0.0), (0.1, 2.0, 3.0)]
)
def test_rays_exist_up_to_the_distortion_limit(r: tuple[float, float, float]) -> None:
    """Some polynomials have an inflection, where an unbounded Newton iteration would leave the valid range."""
    cahv = Cahv.from_axes((100.0, 100.0), (400, 400), axis=(0, 0, 1), right=(1, 0, 0))
    camera = Cahvor.from_cahv(cahv, r=r)
    chi = np.concatenate([np.geomspace(1e-9, 1e-3, 30), np.linspace(0.002, 8, 2000)])
    points = np.stack([0.6 * chi, -0.8 * chi, np.ones_like(chi)], axis=-1)
    pixels, visible = camera.project(points)
    directions = camera.rays(pixels[visible])[1]
    reprojected = camera.project(directions)[0]
    assert visible[:60].all()
    scale = np.maximum(np.abs(pixels[visible]), 1e4)  # The strongest polynomial reaches 1e7 px.
    assert np.max(np.abs(reprojected - pixels[visible]) / scale) < 1e-14
    slope = 1 + r[0] + 3 * r[1] * chi**2 + 5 * r[2] * chi**4
    first_invalid = np.argmax(slope <= 0) if (slope <= 0).any() else len(chi)
    assert visible[:first_invalid].all()
    assert not visible[first_invalid:].any()


def test_fisheye_covers_more_than_ninety_degrees(hazcam: Cahvore) -> None:
    """The hazcam's diagonal is about 180 degrees (Maki et al. 2003): its corners point slightly backwards."""
    corners = hazcam.corner_rays()[1]
    assert np.degrees(np.arccos(corners @ hazcam.boresight()).max()) == pytest.approx(90, abs=5)
    assert (corners @ hazcam.o).min() < 0.02
    equidistant = Cahvore.from_cahv(
        Cahv.from_axes((100.0, 100.0), (401, 401), axis=(0, 0, 1), right=(1, 0, 0)), r=(0, 0, 0), linearity=0
    )
    angle = np.radians([0.0, 45.0, 100.0])
    pixels, visible = equidistant.project(np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1))
    assert visible.all()
    assert np.allclose(pixels[:, 0], 200 + 100 * angle)


# ----- the Jacobian -----


def compute_numerical_jacobian(camera: CameraModel, points: np.ndarray, step: float) -> np.ndarray:
    """Compute the Jacobian of the projection by fourth-order central differences."""
    columns = []
    for axis in np.eye(3):
        plus, minus = (camera.project(points + sign * step * axis)[0] for sign in (1, -1))
        plus_two, minus_two = (camera.project(points + sign * 2 * step * axis)[0] for sign in (1, -1))
        columns.append((8 * (plus - minus) - (plus_two - minus_two)) / (12 * step))
    return np.stack(columns, axis=-1)


def test_jacobian_on_the_optical_axis_matches_finite_differences(navcam: Cahvor, hazcam: Cahvore) -> None:
    for camera in (navcam, hazcam):
        axis = camera.o / np.linalg.norm(camera.o)
        points = camera.c + 3 * axis + np.array([[0.0, 0.0, 0.0], [1e-12, 0, 0], [1e-7, 0, 1e-7]])
        difference = camera.projection_jacobian(points) - compute_numerical_jacobian(camera, points, 1e-3)
        assert np.max(np.abs(difference)) < 1e-7


@given(cameras, arrays(float, (4, 2), elements=st.floats(0.1, 0.9)), st.floats(5, 50))
def test_jacobian_of_random_cameras_matches_differences(camera: CameraModel, uv: np.ndarray, distance_m: float) -> None:
    origins, directions = camera.rays(pixels_from_fractions(camera, uv))
    points = origins + distance_m * directions
    analytic = camera.projection_jacobian(points)
    numerical = compute_numerical_jacobian(camera, points, 1e-4 * distance_m)
    is_valid = np.isfinite(numerical)  # Difference points may be outside the valid range.
    norm = np.linalg.norm(np.where(np.isfinite(analytic), analytic, 0), axis=(-2, -1), keepdims=True)
    # Rounding of points 5000 m away: 1e-12 m / (1e-4 * 5 m) = 2e-9 of the slope. Near a limit the truncation error
    # is larger.
    assert np.all((np.abs(analytic - numerical) <= 2e-5 * norm + 1e-7)[is_valid])


# ----- shapes -----


def test_leading_dimensions_are_preserved(camera: CameraModel) -> None:
    shapes: list[tuple[int, ...]] = [(), (1,), (5,), (2, 3), (0,), (4, 0)]
    for shape in shapes:
        points = np.broadcast_to(camera.c + 3 * camera.a, (*shape, 3))
        pixels, visible = camera.project(points)
        assert pixels.shape == (*shape, 2)
        assert visible.shape == shape
        assert isinstance(visible, np.ndarray)
        assert camera.in_frame(pixels).shape == shape
        origins, directions = camera.rays(pixels)
        assert origins.shape == directions.shape == (*shape, 3)
        assert camera.projection_jacobian(points).shape == (*shape, 2, 3)


def test_single_point_equals_the_point_among_many(camera: CameraModel) -> None:
    """The results are bitwise equal, so they do not depend on the division into blocks."""
    points = camera.c + 3 * camera.rays(camera.pixel_grid()[::4, ::4].reshape(-1, 2))[1]
    all_pixels = camera.project(points)[0]
    assert len(points) > 3 * 16384  # The points fill several blocks.
    for index in (0, 1, 7, 16383, 16384, 40000, len(points) - 1):
        assert np.array_equal(camera.project(points[index])[0], all_pixels[index])


def test_arguments_are_not_modified_and_may_have_single_precision(camera: CameraModel) -> None:
    points = camera.c + np.array([[3.0, 0.1, 0.2], [-3.0, 0.1, 0.2]])
    pixels = np.array([[3.0, 4.0], [500.0, 600.0]])
    # a change would raise an exception
    points.flags.writeable = pixels.flags.writeable = False
    camera.project(points)
    camera.projection_jacobian(points)
    camera.rays(pixels)
    single = points.astype(np.float32)
    result = camera.project(single)[0]
    assert result.dtype == np.float64
    assert np.allclose(result, camera.project(single.astype(float))[0], rtol=0, atol=1e-9, equal_nan=True)


def test_frame_reaches_half_a_pixel_beyond_the_centres(navcam: Cahvor) -> None:
    edge = np.array([[-0.5, 0.0], [-0.51, 0.0], [1023.49, 1023.49], [1023.5, 0.0], [0.0, 1023.5], [np.nan, 0.0]])
    assert navcam.in_frame(edge).tolist() == [True, False, True, False, False, False]
