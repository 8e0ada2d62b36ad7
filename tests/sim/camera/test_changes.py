"""Tests of operations on cameras: rigid motion, binning, scaling, cropping, construction and immutability."""

import copy
import dataclasses
import math
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.sim.camera import Cahv, Cahvor, Cahvore, CameraModel


@st.composite
def draw_transforms(draw: st.DrawFn) -> RigidTransform:
    rotation = Rotation.from_rotvec(draw(arrays(float, 3, elements=st.floats(-3, 3))))
    return RigidTransform.from_components(draw(arrays(float, 3, elements=st.floats(-2000, 2000))), rotation)


def make_points(camera: CameraModel) -> np.ndarray:
    """Return a grid of points over the complete frame, at a distance of 4 m from the camera."""
    origins, directions = camera.rays(camera.pixel_grid()[::100, ::100])
    return np.asarray(origins + 4 * directions)


def stack_cahv(camera: CameraModel) -> np.ndarray:
    return np.stack([getattr(camera, name) for name in "cahv"])


# ----- rigid motion -----


def test_moved_camera_projects_moved_points_equally(camera: CameraModel) -> None:
    motion = RigidTransform.from_components([100.0, -20.0, 5.0], Rotation.from_rotvec([0.4, -1.2, 2.0]))
    points = make_points(camera)
    moved_points = motion.apply(points.reshape(-1, 3)).reshape(points.shape)
    # Points 100 m away are rounded to 1e-14 m; at 4 m and 1200 px/rad this is 4e-12 px.
    assert np.allclose(camera.transform(motion).project(moved_points)[0], camera.project(points)[0], rtol=0, atol=1e-10)


@given(draw_transforms(), draw_transforms())
def test_motions_compose(first: RigidTransform, second: RigidTransform) -> None:
    camera = Cahv.from_field_of_view(0.8, (64, 48), axis=(0, 0, -1), right=(1, 0, 0), centre=(1, 2, 3))
    # Coordinates reach 4000 m: 1e-11 m is a few rounding errors.
    assert np.allclose(
        stack_cahv(camera.transform(first).transform(second)),
        stack_cahv(camera.transform(second * first)),
        rtol=0,
        atol=1e-11,
    )
    assert np.allclose(stack_cahv(camera.transform(first).transform(first.inv())), stack_cahv(camera), 0, 1e-11)


def test_multiple_motions_are_rejected(navcam: Cahvor) -> None:
    with pytest.raises(ValueError, match="single transform"):
        navcam.transform(RigidTransform.identity(2))


# ----- changes of the image -----


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (2, 2), (4, 1), (1, 4), (32, 64)])
def test_binned_pixel_is_at_block_centre(camera: CameraModel, columns: int, rows: int) -> None:
    binned = camera.bin(columns, rows)
    assert binned.size == (1024 // columns, 1024 // rows)
    points = make_points(camera)
    factors = np.array([columns, rows])
    expected = (camera.project(points)[0] - (factors - 1) / 2) / factors
    assert np.allclose(binned.project(points)[0], expected, rtol=0, atol=1e-10)


def test_scaling_preserves_the_frame_edges(camera: CameraModel) -> None:
    points = make_points(camera)
    for factor in (0.5, 0.25, 2, 1.7):
        scaled = camera.scale(factor)
        expected = (camera.project(points)[0] + 0.5) * factor - 0.5
        assert np.allclose(scaled.project(points)[0], expected, rtol=0, atol=1e-9)
        assert scaled.size == (round(1024 * factor), round(1024 * factor))
    assert np.allclose(stack_cahv(camera.scale(0.25)), stack_cahv(camera.bin(4, 4)), rtol=0, atol=1e-12)


def test_cropping_moves_the_origin(camera: CameraModel) -> None:
    cropped = camera.crop(100, 37, (512, 256))
    points = make_points(camera)
    assert cropped.size == (512, 256)
    assert np.allclose(cropped.project(points)[0], camera.project(points)[0] - [100, 37], rtol=0, atol=1e-10)


def test_invalid_changes_are_rejected(navcam: Cahvor) -> None:
    for columns, rows in ((3, 1), (1, 7), (0, 1), (-2, 1), (2048, 1)):
        with pytest.raises(ValueError, match="cannot bin"):
            navcam.bin(columns, rows)
    for factor in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="positive and finite"):
            navcam.scale(factor)
    with pytest.raises(ValueError, match="size"):
        navcam.scale(1e-6)
    for column, row, size in ((-1, 0, (4, 4)), (0, 1020, (4, 5)), (1024, 0, (1, 1))):
        with pytest.raises(ValueError, match="extends beyond the frame"):
            navcam.crop(column, row, size)
    with pytest.raises(ValueError, match="size"):
        navcam.crop(0, 0, (0, 4))


# ----- mirrored camera -----


def test_mirrored_camera_preserves_its_handedness(navcam: Cahvor) -> None:
    mirrored = dataclasses.replace(navcam, h=1023 * navcam.a - navcam.h)
    assert mirrored.theta > 0
    points = make_points(navcam)
    expected = navcam.project(points)[0]
    expected[..., 0] = 1023 - expected[..., 0]
    assert np.allclose(mirrored.project(points)[0], expected, rtol=0, atol=1e-9)
    pixels = navcam.pixel_grid()[::100, ::100]
    assert np.allclose(mirrored.project(mirrored.c + mirrored.rays(pixels)[1])[0], pixels, rtol=0, atol=1e-10)


# ----- construction -----


def test_camera_from_focal_length_and_pitch_matches_the_navcam() -> None:
    """MER's navcam: 14.67 mm, 12 um pixels, 45 degrees across 1024 (Maki et al. 2003)."""
    camera = Cahv.from_focal_length(14.67e-3, 12e-6, (1024, 1024), axis=(1, 0, 0), right=(0, -1, 0), centre=(0, 0, 1.5))
    assert camera.focal_lengths == pytest.approx((1222.5, 1222.5))
    assert camera.image_centre == pytest.approx((511.5, 511.5))
    left, upper = camera.corner_rays()[1][[0, 1]], camera.rays(np.array([511.5, -0.5]))[1]
    assert math.degrees(math.acos(left[0] @ left[1])) == pytest.approx(45, abs=3)
    assert upper[2] > 0  # rows grow downwards
    pixel = camera.project(np.array([10.0, -1.0, 1.5]))[0]
    assert pixel == pytest.approx([511.5 + 122.25, 511.5])


def test_pixel_pitch_may_differ_between_axes() -> None:
    camera = Cahv.from_focal_length(
        0.01, (1e-5, 4e-5), (100, 25), axis=(0, 0, -2), right=(3, 0, 1), image_centre=(40, 10)
    )
    assert camera.focal_lengths == pytest.approx((1000, 250))
    assert camera.image_centre == pytest.approx((40, 10))
    assert np.allclose(camera.right, (1, 0, 0))
    assert np.allclose(camera.down, (0, -1, 0))


def test_field_of_view_includes_the_outer_edges() -> None:
    camera = Cahv.from_field_of_view(math.radians(60), (100, 50), axis=(0, 0, 1), right=(1, 0, 0))
    left, right = camera.rays(np.array([[-0.5, 24.5], [99.5, 24.5]]))[1]
    assert math.degrees(math.acos(left @ right)) == pytest.approx(60)
    assert camera.focal_lengths[0] == pytest.approx(camera.focal_lengths[1])
    with_vertical = Cahv.from_field_of_view(1.0, (100, 50), vertical_rad=0.8, axis=(0, 0, 1), right=(1, 0, 0))
    upper, lower = with_vertical.rays(np.array([[49.5, -0.5], [49.5, 49.5]]))[1]
    assert math.acos(upper @ lower) == pytest.approx(0.8)
    assert np.allclose(with_vertical.boresight(), (0, 0, 1))


def test_invalid_construction_is_rejected() -> None:
    with pytest.raises(ValueError, match="parallel"):
        Cahv.from_axes((1, 1), (4, 4), axis=(0, 0, 1), right=(0, 0, 2))
    with pytest.raises(ValueError, match="axis must be a finite vector"):
        Cahv.from_axes((1, 1), (4, 4), axis=(0, 0, 0), right=(0, 0, 2))
    for focal in ((0, 1), (1, -1), (math.nan, 1), (math.inf, 1)):
        with pytest.raises(ValueError, match="focal lengths"):
            Cahv.from_axes(focal, (4, 4), axis=(0, 0, 1), right=(1, 0, 0))
    with pytest.raises(ValueError, match="pixel pitch"):
        Cahv.from_focal_length(0.01, 0, (4, 4), axis=(0, 0, 1), right=(1, 0, 0))
    for angle in (0, math.pi, -1):
        with pytest.raises(ValueError, match="field of view"):
            Cahv.from_field_of_view(angle, (4, 4), axis=(0, 0, 1), right=(1, 0, 0))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"a": np.array([1.0, 1.0, 0.0])}, "a must be a unit vector"),
        ({"a": np.array([1.0, 0.001, 0.05])}, "a must be a unit vector"),
        ({"c": np.array([np.nan, 0.0, 0.0])}, "c must be finite"),
        ({"h": np.array([np.inf, 0.0, 0.0])}, "h must be finite"),
        ({"h": np.zeros(3)}, "linearly independent"),
        ({"v": np.array([0.93995, -0.338133, 0.0464979])}, "linearly independent"),
        ({"size": (0, 4)}, "size must be"),
        ({"size": (4, -4)}, "size must be"),
        ({"o": np.array([1.0, 1.0, 0.0])}, "o must be a unit vector"),
        ({"o": np.array([-0.946551, 0.315595, -0.0666419])}, "same side"),
        ({"r": np.array([0.0, np.nan, 0.0])}, "r must be finite"),
        ({"r": np.array([-1.0, 0.0, 0.0])}, "r must begin with a number above -1"),
    ],
)
def test_invalid_fields_are_rejected(navcam: Cahvor, change: dict[str, Any], fault: str) -> None:
    with pytest.raises(ValueError, match=fault):
        dataclasses.replace(navcam, **change)


@pytest.mark.parametrize("linearity", [1.01, -1.01, math.nan, math.inf])
def test_invalid_linearity_is_rejected(hazcam: Cahvore, linearity: float) -> None:
    with pytest.raises(ValueError, match="linearity must lie between -1 and 1"):
        dataclasses.replace(hazcam, linearity=linearity)


# ----- immutability and equality -----


def test_cameras_are_immutable(camera: CameraModel) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera.c = np.zeros(3)
    with pytest.raises(ValueError, match="read-only"):
        camera.c[0] = 1.0


def test_cameras_copy_their_arrays(navcam: Cahvor) -> None:
    centre = np.array([1.0, 2.0, 3.0])
    camera = dataclasses.replace(navcam, c=centre)
    centre[:] = 0
    assert camera.c.tolist() == [1, 2, 3]


def copy_by_pickle(camera: CameraModel) -> CameraModel:
    """Return the camera as a worker process receives it."""
    camera_copy: CameraModel = pickle.loads(pickle.dumps(camera))  # noqa: S301
    return camera_copy


@pytest.mark.parametrize("copy_camera", [copy.copy, copy.deepcopy, copy_by_pickle])
def test_copies_are_equal_and_immutable(camera: CameraModel, copy_camera: Callable[[CameraModel], CameraModel]) -> None:
    camera.rays(np.zeros(2))  # Fills the cache of the camera.
    camera_copy = copy_camera(camera)
    assert camera_copy == camera
    assert hash(camera_copy) == hash(camera)
    assert not camera_copy.c.flags.writeable
    assert camera_copy in {camera}


def test_different_cameras_differ(navcam: Cahvor, pinhole: Cahv) -> None:
    assert navcam != pinhole
    assert navcam != dataclasses.replace(navcam, size=(1024, 1023))
    assert navcam != dataclasses.replace(navcam, r=np.zeros(3))
    assert navcam != "navcam"
    assert dataclasses.replace(navcam, c=np.array([0.0, 0, 0])) == dataclasses.replace(navcam, c=np.array([-0.0, 0, 0]))


def test_derived_quantities_match_the_formulas_of_cmod(navcam: Cahvor) -> None:
    """Compare with cmod_cahv_internal of JPL's cmod library, which assumes that A is a unit vector.

    The label rounds A to six digits.
    """
    hs, vs = navcam.focal_lengths
    hc, vc = navcam.image_centre
    assert hs == pytest.approx(np.linalg.norm(np.cross(navcam.a, navcam.h)), rel=2e-6)
    assert vs == pytest.approx(np.linalg.norm(np.cross(navcam.a, navcam.v)), rel=2e-6)
    assert hc == pytest.approx(navcam.a @ navcam.h, rel=3e-6)
    assert vc == pytest.approx(navcam.a @ navcam.v, rel=3e-6)
    a_cross_v, a_cross_h = np.cross(navcam.a, navcam.v), np.cross(navcam.a, navcam.h)
    theta = math.atan2(np.cross(navcam.v, navcam.h) @ navcam.a, a_cross_v @ a_cross_h)
    assert navcam.theta == pytest.approx(theta, abs=1e-8)
    assert np.allclose(hs * navcam.right + hc * navcam.a, navcam.h, atol=1e-2)
    half_angles = np.arccos(navcam.corner_rays()[1] @ navcam.boresight())
    assert np.degrees(2 * half_angles.max()) == pytest.approx(61.4, abs=0.1)  # diagonal of 45 x 45 degrees


def test_corner_rays_are_in_clockwise_order(camera: CameraModel) -> None:
    origins, directions = camera.corner_rays()
    pixels = camera.project(origins + directions)[0]
    assert np.allclose(pixels, [[-0.5, -0.5], [1023.5, -0.5], [1023.5, 1023.5], [-0.5, 1023.5]], rtol=0, atol=1e-9)
