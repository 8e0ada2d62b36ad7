"""Checks of the illumination in images: opposition peak, cast shadows, reflectance law, cloud shadows, sun disc."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from benchmarks.validation.limits import find_limit
from benchmarks.validation.motion import View, render
from benchmarks.validation.raycast import Ground, cast_triangles
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import (
    CAMERA_CONDITIONS,
    DESCENT,
    MAST,
    cameras,
    descent_conditions,
    descent_view,
    ground_view,
    renderer,
    rock_view,
)
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import CloudLayer, CloudParameters, DustySky, Photometry, PixelRays, Scene, Sun, Texture
from marsyard.sim.terrain import Surface

#: Brightness is albedo times the cosine of incidence in sunlight, and 0 in shadow.
LAMBERT = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0, surrounding_albedo=0.0)
#: Albedo of the ground in checks that do not compare albedos.
FLAT_ALBEDO = 0.2
#: Maximum range of compared pixels from a mast.
MAX_MAST_RANGE_M = 40.0
#: Reflectance laws of the check, by name.
LAWS = {
    "Lambert": Photometry(lunar_fraction=0.0, surge_amplitude=0.0),
    "Mars": Photometry(),
    "dark lava": Photometry(lunar_fraction=0.6, surge_amplitude=0.9, surge_width=0.08),
    "narrow surge": Photometry(lunar_fraction=1.0, surge_amplitude=1.5, surge_width=0.01),
}


def make_flat_surface(albedo: float = FLAT_ALBEDO) -> Surface:
    """Create level ground with uniform albedo."""
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    samples[..., 1] = albedo
    return Surface.from_samples(samples, 64.0)


def run_opposition(quick: bool) -> Iterator[Measure]:
    """Compare the centre of the opposition peak in images with the antisolar point."""
    law = Photometry(lunar_fraction=0.0, surge_amplitude=1.0, surge_width=0.02, sky_fraction=0.0)
    rng = np.random.default_rng(3)
    surface = make_flat_surface()
    for name, camera in cameras().items():
        errors = []
        for _ in range(3 if quick else 10):
            # the antisolar point is at a random pixel
            pixel = rng.uniform(0.2, 0.8, 2) * camera.size
            attitude = Rotation.align_vectors(np.array([[0.2, 0.1, -1.0]]), camera.boresight()[None])[0]
            pose = rigid(attitude, np.array([0.0, 0.0, 800.0]))
            _, ray = camera.transform(pose).rays(pixel)
            if ray[2] > -0.3:
                continue
            view = View(Scene(surface, (0.0, 0.0), Sun(-ray), law), camera, pose)
            radiance = render(renderer(), view).radiance.astype(np.float64)
            errors.append(float(np.linalg.norm(_locate_peak(radiance) - pixel)))
        how = f"{len(errors)} positions of the sun; centroid of radiance above 90 % of the peak"
        claim = f"distance of opposition peak from antisolar point: {name}"
        yield Measure(claim, max(errors), "px", find_limit(claim), how)


def _locate_peak(radiance: np.ndarray) -> np.ndarray:
    """Centroid of the radiance above 90 % of the peak."""
    weight = np.clip(radiance - radiance.max() + 0.1 * np.ptp(radiance), 0.0, None)
    v, u = np.mgrid[: radiance.shape[0], : radiance.shape[1]]
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def make_uniform(view: View, sun: Sun) -> View:
    """Return the view with this sun, uniform albedo and Lambert's law."""
    samples = view.scene.surface.levels[0].copy()
    samples[..., 1] = FLAT_ALBEDO
    scene = replace(
        view.scene,
        surface=Surface.from_samples(samples, view.scene.surface.spacing_m),
        sun=sun,
        photometry=LAMBERT,
        objects=replace(view.scene.objects, albedo=np.full(len(view.scene.objects), FLAT_ALBEDO)),
        ground_texture=Texture(),
        object_texture=Texture(),
        # one ray per pixel, because shadows are compared at the intersection of this ray
        edge_rays=1,
    )
    return replace(view, scene=scene)


def _compare_shadows(name: str, view: View, sun: Sun, count: int, max_range_m: float, step: float) -> Measure:
    """Compare cast shadows at `count` random pixels with independent ray casting in steps of `step` metres."""
    view = make_uniform(view, sun)
    frame = render(renderer(), view)
    points = frame.points_world().reshape(-1, 3)
    candidates = np.flatnonzero(frame.range_m.ravel() < max_range_m)
    pixels = np.random.default_rng(6).choice(candidates, min(count, candidates.size), replace=False)
    points, normals = points[pixels], frame.normal.reshape(-1, 3)[pixels].astype(np.float64)
    to_sun = np.asarray(sun.direction, dtype=np.float64)
    cos_i = normals @ to_sun
    sunlit_fraction = frame.radiance.ravel()[pixels] / (FLAT_ALBEDO * np.maximum(cos_i, 1e-6))
    is_lit_in_image = (cos_i > 0.0) & (sunlit_fraction > 0.5)
    ground = Ground(view.scene.surface)
    # the renderer smooths distant ground; exact heights are used, because only shadows are compared
    on_ground = frame.body.ravel()[pixels] < 0
    points[on_ground, 2] = ground.height(points[on_ground, 0], points[on_ground, 1])
    is_occluded = ground.is_occluded(points, to_sun, step)
    rays = np.broadcast_to(to_sun, points.shape)
    is_occluded |= np.isfinite(cast_triangles(view.scene.objects, points, rays, nearest=2e-3))
    is_lit_in_reference = (cos_i > 0.0) & ~is_occluded
    agreement = float(np.mean(is_lit_in_image == is_lit_in_reference))
    is_in_cast_shadow = (cos_i > 0.0) & is_occluded
    is_dark_in_image = ~is_lit_in_image[is_in_cast_shadow]
    dark_text = f", of which {np.mean(is_dark_in_image):.0%} are dark in the image" if is_in_cast_shadow.any() else ""
    how = (
        f"{pixels.size} random pixels, {np.mean(cos_i <= 0.0):.1%} facing away from the sun, "
        f"{np.mean(is_in_cast_shadow):.1%} in cast shadow{dark_text}; "
        f"{np.mean(is_lit_in_reference & ~is_lit_in_image):.2%} wrongly dark"
    )
    # about three times the maximum disagreement from the air (0.03 %), and twice that from a mast (0.24 %)
    limit = 0.999 if max_range_m > MAX_MAST_RANGE_M else 0.995
    return Measure(f"shadows equal to those of independent ray casting: {name}", agreement, "", limit, how, "at least")


def run_shadows(quick: bool) -> Iterator[Measure]:
    """Compare cast shadows in images from the air and from a mast with independent ray casting."""
    count = 2000 if quick else 20000
    sun_20_deg, sun_10_deg = (
        Sun(direction(np.radians(110.0), np.radians(20.0))),
        Sun(direction(np.radians(245.0), np.radians(10.0))),
    )
    pisgah = descent_view("pisgah", 2000.0, (1024, 1024))
    ground_only = replace(pisgah, scene=replace(pisgah.scene, objects=pisgah.scene.objects.none()))
    dunes, ripples = descent_view("kelso", 1000.0, (1024, 1024)), ground_view("gusev")
    for sun, elevation in ((sun_20_deg, 20), (sun_10_deg, 10)):
        yield _compare_shadows(f"pisgah's ground from 2 km, sun at {elevation} deg", ground_only, sun, count, 1e5, 0.4)
        yield _compare_shadows(f"kelso's dunes from 1 km, sun at {elevation} deg", dunes, sun, count, 1e5, 0.4)
        yield _compare_shadows(
            f"ripples from a mast, sun at {elevation} deg", ripples, sun, count // 2, MAX_MAST_RANGE_M, 0.008
        )
    yield _compare_shadows("pisgah with rocks from 2 km, sun at 20 deg", pisgah, sun_20_deg, count // 2, 1e5, 0.4)
    rocks, sun_30_deg = rock_view("gusev", 5.0), Sun(direction(np.radians(35.0), np.radians(30.0)))
    yield _compare_shadows("rocks from a mast, sun at 30 deg", rocks, sun_30_deg, count // 4, MAX_MAST_RANGE_M, 0.008)


def _make_nadir_camera() -> Cahv:
    """Create a nadir camera with 9 x 9 pixels."""
    return Cahv.from_field_of_view(
        horizontal_rad=0.002,
        size=(9, 9),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )


def _render_brightness(law: Photometry, to_sun: np.ndarray, to_eye: np.ndarray) -> float:
    """Render flat ground in direct sunlight; return the brightness of the central pixel."""
    attitude = Rotation.align_vectors(-to_eye[None], np.array([[0.0, 0.0, -1.0]]))[0]
    view = View(
        Scene(make_flat_surface(), (0.0, 0.0), Sun(to_sun), law), _make_nadir_camera(), rigid(attitude, 100.0 * to_eye)
    )
    return float(render(renderer(), view).radiance[4, 4])


def _reflectance(law: Photometry, cos_i: np.ndarray, cos_e: np.ndarray, cos_g: npt.ArrayLike) -> np.ndarray:
    """Independent implementation of the law of `Photometry`, for unit albedo A and unit normalisation factor K."""
    # phase angle
    g = np.arccos(np.clip(cos_g, -1.0, 1.0))
    surge = 1.0 + law.surge_amplitude / (1.0 + np.tan(0.5 * g) / law.surge_width)
    lunar = law.lunar_fraction
    return surge * (2.0 * lunar * cos_i / (cos_i + cos_e) + (1.0 - lunar) * cos_i)


def run_reflectance(quick: bool) -> Iterator[Measure]:
    """Check reciprocity, formula and spherical albedo of the reflectance laws."""
    rng = np.random.default_rng(9)
    pairs = 10 if quick else 40
    for name, law in LAWS.items():
        sun_only = replace(law, sky_fraction=0.0, surrounding_albedo=0.0)
        reciprocity_errors, formula_errors = [], []
        for _ in range(pairs):
            first, second = (
                direction(float(rng.uniform(0.0, 2.0 * np.pi)), float(np.arcsin(rng.uniform(0.15, 1.0))))
                for _ in range(2)
            )
            forward, backward = _render_brightness(sun_only, first, second), _render_brightness(sun_only, second, first)
            # I/F divided by the cosine of incidence is pi times the bidirectional reflectance
            reciprocity_errors.append(abs(forward / first[2] / (backward / second[2]) - 1.0))
            expected_brightness = (
                FLAT_ALBEDO
                * sun_only.normalisation()
                * _reflectance(sun_only, first[2], second[2], float(first @ second))
            )
            formula_errors.append(float(abs(forward / expected_brightness - 1.0)))
        how = f"{pairs} pairs of sun and camera directions over flat ground"
        albedo = abs(_spherical_albedo(sun_only, 20) * sun_only.normalisation() - 1.0)
        for claim, value, method in (
            ("rendered reflectance is reciprocal", max(reciprocity_errors), how),
            ("rendered brightness compared with the formula", max(formula_errors), how),
            (
                "spherical albedo, difference from the specified value",
                albedo,
                "the law integrated over sun and camera directions by Sobol points",
            ),
        ):
            yield Measure(f"{claim}: {name}", value, "", find_limit(f"{claim}: {name}"), method)


def _spherical_albedo(law: Photometry, log2_points: int) -> float:
    """Fraction of isotropic light that the law with A = K = 1 reflects, by quasi-Monte Carlo.

    Directions of sun and camera are drawn in proportion to their cosines. The result is the mean of I/F divided by the
    cosine of incidence.
    """
    u_sun, u_camera, u_azimuth = qmc.Sobol(3, rng=np.random.default_rng(1)).random_base2(log2_points).T
    cos_i, cos_e = np.sqrt(1.0 - u_sun), np.sqrt(1.0 - u_camera)
    cos_g = cos_i * cos_e + np.sqrt(u_sun * u_camera) * np.cos(2.0 * np.pi * u_azimuth)
    return float(np.mean(_reflectance(law, cos_i, cos_e, cos_g) / cos_i))


def run_clouds(quick: bool) -> Iterator[Measure]:
    """Measure cloud cover and motion of cloud shadows in images."""
    camera, law = cameras()["MER descent camera, CAHVOR, 45 deg"], LAMBERT
    sun = Sun(direction(np.radians(150.0), np.radians(45.0)))
    parameters = CloudParameters(cover=0.3, size_m=400.0, optical_depth=50.0)
    direct_light = FLAT_ALBEDO * float(sun.direction[2])
    covers, motion_errors = [], []
    for seed in range(2 if quick else 8):
        layer = CloudLayer.draw(parameters, np.random.default_rng(seed))
        scene = Scene(make_flat_surface(), (0.0, 0.0), sun, law, clouds=layer, edge_rays=1)
        rng = np.random.default_rng(100 + seed)
        sky_light = FLAT_ALBEDO * parameters.sky_light(sun)
        for position in rng.uniform(0.0, 12800.0, (4, 2)):
            image = _render_from_above(scene, camera, position, 0.0)
            covers.append(1.0 - float(np.mean((image - sky_light) / direct_light)))
            later_image = _render_from_above(
                scene, camera, position + 3.75 * np.array([parameters.wind_east_m_s, parameters.wind_north_m_s]), 3.75
            )
            slope = np.hypot(*np.gradient(image))
            is_edge = slope > 0.2 * slope.max()
            motion_errors.append(float(np.max(np.abs(later_image - image)[is_edge] / slope[is_edge])))
    how = f"{len(covers)} images from 2 km over flat ground, {2 if quick else 8} layers; cover {parameters.cover:g}"
    yield Measure(
        "fraction of the ground in cloud shadows, difference from the specified cover",
        abs(float(np.mean(covers)) - parameters.cover),
        "",
        0.1,
        how,
    )
    how = "two images 3.75 s apart, the second camera moved with the wind; change divided by slope at the edges"
    # both images evaluate the same function of position; the limit allows for rounding errors
    yield Measure("motion of cloud shadows, difference from the wind", max(motion_errors), "px", 1e-4, how)


def _render_from_above(scene: Scene, camera: CameraModel, position: np.ndarray, time_s: float) -> np.ndarray:
    """Render the radiance from 2 km above a position (east, north), m."""
    pose = rigid(Rotation.identity(), np.array([*position, 2000.0]))
    return renderer().render(scene, PixelRays.from_camera(camera), pose, time_s).radiance.astype(np.float64)


def run_sun(quick: bool) -> Iterator[Measure]:
    """Compare direction and flux of the sun's disc in the image with those of the sun.

    The disc covers 40 pixels, and the coverage of a pixel at its edge is approximate: the errors are random.
    """
    camera, rng = cameras()["MER navcam, CAHVOR, 45 deg"], np.random.default_rng(3)
    direction_errors, flux_errors = [], []
    for azimuth_deg, elevation_deg in rng.uniform((82.0, 5.0), (98.0, 16.0), (3 if quick else 14, 2)):
        sun = Sun(direction(np.radians(azimuth_deg), np.radians(elevation_deg)))
        law = Photometry(sky_fraction=0.3, sky=DustySky(0.5, 0.95, 0.65))
        pose = rigid(Rotation.identity(), np.array([0.0, 0.0, 1.5]))
        scene = Scene(make_flat_surface(), (0.0, 0.0), sun, law, mesh_finest_m=0.5, mesh_half_width_m=2000.0)
        rays = PixelRays.from_camera(camera)
        radiance = renderer().render(scene, rays, pose).radiance.astype(np.float64)
        # only the sun's disc is brighter
        sun_radiance = np.where(radiance > 1000.0, radiance, 0.0)
        rows, columns = np.indices(radiance.shape)
        centre = np.array([(sun_radiance * columns).sum(), (sun_radiance * rows).sum()]) / sun_radiance.sum()
        direction_errors.append(float(np.linalg.norm(centre - camera.project(1e9 * sun.direction)[0])))
        solid_angle = np.square(rays.pixel_angles.astype(np.float64)).reshape(radiance.shape)
        flux_errors.append(float((sun_radiance * solid_angle).sum()) / np.pi - 1.0)
    claim = "position of the sun's disc, RMS difference from the sun's direction"
    how = f"{len(direction_errors)} positions of the sun in navcam images"
    yield Measure(claim, float(np.sqrt(np.mean(np.square(direction_errors)))), "px", find_limit(claim), how)
    claim = "flux of the sun's disc compared with direct sunlight, RMS difference"
    how = f"the same images; mean difference {np.mean(flux_errors):+.2%}"
    yield Measure(claim, float(np.sqrt(np.mean(np.square(flux_errors)))), "", find_limit(claim), how)


_SUN_10, _SUN_20, _SUN_30 = (10.0, 10.0), (20.0, 20.0), (30.0, 30.0)
_PISGAH = descent_conditions("*pisgah*20 deg", "pisgah", 2000.0, 20.0)
_KELSO = descent_conditions("*kelso*20 deg", "kelso", 1000.0, 20.0)
_RIPPLES = Conditions("*ripples*20 deg", MAST, site=("gusev",), sun_elevation_deg=_SUN_20, range_m=(1.6, 40.0))
CHECKS = (
    Check("opposition", "Light", run_opposition, conditions=CAMERA_CONDITIONS),
    Check(
        "shadows",
        "Light",
        run_shadows,
        conditions=(
            *(
                item
                for ground in (_PISGAH, _KELSO, _RIPPLES)
                for item in (
                    ground,
                    replace(ground, rows=ground.rows.replace("20 deg", "10 deg"), sun_elevation_deg=_SUN_10),
                )
            ),
            Conditions("*rocks*30 deg", MAST, site=("gusev",), sun_elevation_deg=_SUN_30, range_m=(5.0, 40.0)),
        ),
    ),
    # flat ground without shadows: no evidence on the light of a terrain
    Check("reflectance", "Light", run_reflectance),
    Check(
        "clouds",
        "Light",
        run_clouds,
        conditions=(Conditions("*", DESCENT, sun_elevation_deg=(45.0, 45.0), range_m=(2000.0, 2000.0)),),
    ),
    Check("sun", "Light", run_sun, conditions=(Conditions("*", MAST, sun_elevation_deg=(5.0, 16.0)),)),
)
