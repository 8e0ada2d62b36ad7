"""Checks of light: opposition peak, cast shadows, reflectance law, clouds and sun."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from benchmarks.validation.limits import find_limit
from benchmarks.validation.motion import View, render
from benchmarks.validation.raycast import Ground, meet_triangles
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import cameras, descent_view, ground_view, renderer, rock_view
from marsyard.sim.camera import Cahv, CameraModel
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import CloudLayer, CloudParameters, DustySky, Photometry, PixelRays, Scene, Sun, Texture
from marsyard.sim.terrain import Surface

#: Brightness is albedo times the cosine of incidence in sunlight, and 0 in shadow.
LAMBERT = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_share=0.0, surrounding_albedo=0.0)
FLAT_ALBEDO = 0.2
FARTHEST_FROM_A_MAST_M = 40.0
LAWS = {
    "Lambert": Photometry(lunar_fraction=0.0, surge_amplitude=0.0),
    "Mars": Photometry(),
    "dark lava": Photometry(lunar_fraction=0.6, surge_amplitude=0.9, surge_width=0.08),
    "narrow surge": Photometry(lunar_fraction=1.0, surge_amplitude=1.5, surge_width=0.01),
}


def _flat(albedo: float = FLAT_ALBEDO) -> Surface:
    samples = np.zeros((64, 64, 2), dtype=np.float32)
    samples[..., 1] = albedo
    return Surface.from_samples(samples, 64.0)


def run_opposition(quick: bool) -> Iterator[Measure]:
    """Compare the centre of the opposition peak in the image with the antisolar point."""
    law = Photometry(lunar_fraction=0.0, surge_amplitude=1.0, surge_width=0.02, sky_share=0.0)
    rng = np.random.default_rng(3)
    surface = _flat()
    for name, camera in cameras().items():
        errors = []
        for _ in range(3 if quick else 10):
            # the antisolar point is at a random pixel
            pixel = rng.uniform(0.2, 0.8, 2) * camera.size
            turn = Rotation.align_vectors(np.array([[0.2, 0.1, -1.0]]), camera.boresight()[None])[0]
            pose = rigid(turn, np.array([0.0, 0.0, 800.0]))
            _, ray = camera.transform(pose).rays(pixel)
            if ray[2] > -0.3:
                continue
            view = View(Scene(surface, (0.0, 0.0), Sun(-ray), law), camera, pose)
            radiance = render(renderer(), view).radiance.astype(np.float64)
            errors.append(float(np.linalg.norm(_peak(radiance) - pixel)))
        how = f"{len(errors)} suns; centre of the light above 90 % of the peak's height"
        claim = f"opposition peak from the antisolar point: {name}"
        yield Measure(claim, max(errors), "px", find_limit(claim), how)


def _peak(radiance: np.ndarray) -> np.ndarray:
    """Centre of the light above 90 % of the peak's height."""
    weight = np.clip(radiance - radiance.max() + 0.1 * np.ptp(radiance), 0.0, None)
    v, u = np.mgrid[: radiance.shape[0], : radiance.shape[1]]
    return np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()


def make_uniform(view: View, sun: Sun) -> View:
    """The view with another sun, uniform albedo and Lambert's law."""
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
        # one ray per pixel, because light is compared at the intersection of this ray
        edge_rays=1,
    )
    return replace(view, scene=scene)


def _shadow_row(name: str, view: View, sun: Sun, count: int, farthest: float, step: float) -> Measure:
    view = make_uniform(view, sun)
    frame = render(renderer(), view)
    points = frame.points_world().reshape(-1, 3)
    seen = np.flatnonzero(frame.range_m.ravel() < farthest)
    pixels = np.random.default_rng(6).choice(seen, min(count, seen.size), replace=False)
    points, normals = points[pixels], frame.normal.reshape(-1, 3)[pixels].astype(np.float64)
    towards = np.asarray(sun.direction, dtype=np.float64)
    facing = normals @ towards
    share = frame.radiance.ravel()[pixels] / (FLAT_ALBEDO * np.maximum(facing, 1e-6))
    ours = (facing > 0.0) & (share > 0.5)
    ground = Ground(view.scene.surface)
    # the renderer smooths distant ground: use exact heights, because only shadows are compared
    on_ground = frame.body.ravel()[pixels] < 0
    points[on_ground, 2] = ground.height(points[on_ground, 0], points[on_ground, 1])
    hidden = ground.hides(points, towards, step)
    rays = np.broadcast_to(towards, points.shape)
    hidden |= np.isfinite(meet_triangles(view.scene.objects, points, rays, nearest=2e-3))
    theirs = (facing > 0.0) & ~hidden
    agree = float(np.mean(ours == theirs))
    cast = (facing > 0.0) & hidden
    dark_text = f", of which {np.mean(~ours[cast]):.0%} are dark in the picture" if cast.any() else ""
    how = (
        f"{pixels.size} random pixels, {np.mean(facing <= 0.0):.1%} turned from the sun, "
        f"{np.mean(cast):.1%} in cast shadow{dark_text}; {np.mean(theirs & ~ours):.2%} wrongly dark"
    )
    # about three times the maximum disagreement from the air (0.03 %), and twice that from a mast (0.24 %)
    limit = 0.999 if farthest > FARTHEST_FROM_A_MAST_M else 0.995
    return Measure(f"shadows as an independent ray cast has them: {name}", agree, "", limit, how, "at least")


def run_shadows(quick: bool) -> Iterator[Measure]:
    count = 2000 if quick else 20000
    low, lower = (
        Sun(direction(np.radians(110.0), np.radians(20.0))),
        Sun(direction(np.radians(245.0), np.radians(10.0))),
    )
    pisgah = descent_view("pisgah", 2000.0, (1024, 1024))
    ground_only = replace(pisgah, scene=replace(pisgah.scene, objects=pisgah.scene.objects.none()))
    dunes, ripples = descent_view("kelso", 1000.0, (1024, 1024)), ground_view("gusev")
    for sun, elevation in ((low, 20), (lower, 10)):
        yield _shadow_row(f"pisgah's ground from 2 km, sun at {elevation} deg", ground_only, sun, count, 1e5, 0.4)
        yield _shadow_row(f"kelso's dunes from 1 km, sun at {elevation} deg", dunes, sun, count, 1e5, 0.4)
        yield _shadow_row(
            f"ripples from a mast, sun at {elevation} deg", ripples, sun, count // 2, FARTHEST_FROM_A_MAST_M, 0.008
        )
    yield _shadow_row("pisgah with rocks from 2 km, sun at 20 deg", pisgah, low, count // 2, 1e5, 0.4)
    rocks, high = rock_view("gusev", 5.0), Sun(direction(np.radians(35.0), np.radians(30.0)))
    yield _shadow_row("rocks from a mast, sun at 30 deg", rocks, high, count // 4, FARTHEST_FROM_A_MAST_M, 0.008)


def _single_pixel() -> Cahv:
    """A nadir camera with 9 x 9 pixels."""
    return Cahv.from_field_of_view(
        horizontal_rad=0.002,
        size=(9, 9),
        centre=np.zeros(3),
        axis=np.array([0.0, 0.0, -1.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )


def _rendered_brightness(law: Photometry, to_sun: np.ndarray, to_eye: np.ndarray) -> float:
    """Brightness of flat ground in direct sunlight, from the central pixel of an image."""
    turn = Rotation.align_vectors(-to_eye[None], np.array([[0.0, 0.0, -1.0]]))[0]
    view = View(Scene(_flat(), (0.0, 0.0), Sun(to_sun), law), _single_pixel(), rigid(turn, 100.0 * to_eye))
    return float(render(renderer(), view).radiance[4, 4])


def _law(law: Photometry, cos_i: np.ndarray, cos_e: np.ndarray, cos_g: npt.ArrayLike) -> np.ndarray:
    """Independent implementation of the law of `Photometry`, for unit albedo and K."""
    g = np.arccos(np.clip(cos_g, -1.0, 1.0))
    surge = 1.0 + law.surge_amplitude / (1.0 + np.tan(0.5 * g) / law.surge_width)
    share = law.lunar_fraction
    return surge * (2.0 * share * cos_i / (cos_i + cos_e) + (1.0 - share) * cos_i)


def run_reflectance(quick: bool) -> Iterator[Measure]:
    rng = np.random.default_rng(9)
    pairs = 10 if quick else 40
    for name, law in LAWS.items():
        bare = replace(law, sky_share=0.0, surrounding_albedo=0.0)
        away, off = [], []
        for _ in range(pairs):
            first, second = (
                direction(float(rng.uniform(0.0, 2.0 * np.pi)), float(np.arcsin(rng.uniform(0.15, 1.0))))
                for _ in range(2)
            )
            there, back = _rendered_brightness(bare, first, second), _rendered_brightness(bare, second, first)
            # I/F divided by the cosine of incidence is pi times the bidirectional reflectance
            away.append(abs(there / first[2] / (back / second[2]) - 1.0))
            expected = FLAT_ALBEDO * bare.normalisation() * _law(bare, first[2], second[2], float(first @ second))
            off.append(float(abs(there / expected - 1.0)))
        how = f"{pairs} pairs of sun and eye over flat ground"
        albedo = abs(_spherical_albedo(bare, 20) * bare.normalisation() - 1.0)
        for claim, measured, by in (
            ("rendered reflectance is reciprocal", max(away), how),
            ("rendered brightness against the formula", max(off), how),
            ("spherical albedo from the stated one", albedo, "the law integrated over sun and eye by Sobol points"),
        ):
            yield Measure(f"{claim}: {name}", measured, "", find_limit(f"{claim}: {name}"), by)


def _spherical_albedo(law: Photometry, log2_points: int) -> float:
    """Fraction of isotropic light that the law with A = K = 1 reflects, by quasi-Monte Carlo.

    Sun and eye are drawn in proportion to their cosines. The result is the mean of I/F over the cosine of incidence.
    """
    one, two, turn = qmc.Sobol(3, rng=np.random.default_rng(1)).random_base2(log2_points).T
    cos_i, cos_e = np.sqrt(1.0 - one), np.sqrt(1.0 - two)
    cos_g = cos_i * cos_e + np.sqrt(one * two) * np.cos(2.0 * np.pi * turn)
    return float(np.mean(_law(law, cos_i, cos_e, cos_g) / cos_i))


def run_clouds(quick: bool) -> Iterator[Measure]:
    """Measure cloud cover and motion of cloud shadows in images."""
    camera, law = cameras()["MER descent camera, CAHVOR, 45 deg"], LAMBERT
    sun = Sun(direction(np.radians(150.0), np.radians(45.0)))
    given = CloudParameters(cover=0.3, size_m=400.0, optical_depth=50.0)
    lit = FLAT_ALBEDO * float(sun.direction[2])
    covers, moved = [], []
    for seed in range(2 if quick else 8):
        layer = CloudLayer.draw(given, np.random.default_rng(seed))
        scene = Scene(_flat(), (0.0, 0.0), sun, law, clouds=layer, edge_rays=1)
        rng = np.random.default_rng(100 + seed)
        more = FLAT_ALBEDO * given.sky_light(sun)
        for place in rng.uniform(0.0, 12800.0, (4, 2)):
            picture = _from_above(scene, camera, place, 0.0)
            covers.append(1.0 - float(np.mean((picture - more) / lit)))
            later = _from_above(
                scene, camera, place + 3.75 * np.array([given.wind_east_m_s, given.wind_north_m_s]), 3.75
            )
            steep = np.hypot(*np.gradient(picture))
            clear = steep > 0.2 * steep.max()
            moved.append(float(np.max(np.abs(later - picture)[clear] / steep[clear])))
    how = (
        f"{len(covers)} pictures from 2 km over flat ground, {2 if quick else 8} layers; {given.cover:g} was asked for"
    )
    yield Measure(
        "share of the ground in clouds' shadows, from the stated one", abs(float(np.mean(covers)) - 0.3), "", 0.1, how
    )
    how = "two pictures 3.75 s apart, the later from a place that drifted with the wind; change over slope at the edges"
    # the same function is evaluated at a shifted position: the bound allows for rounding
    yield Measure("motion of clouds' shadows from the wind's", max(moved), "px", 1e-4, how)


def _from_above(scene: Scene, camera: CameraModel, place: np.ndarray, time_s: float) -> np.ndarray:
    pose = rigid(Rotation.identity(), np.array([*place, 2000.0]))
    return renderer().render(scene, PixelRays.of(camera), pose, time_s).radiance.astype(np.float64)


def run_sun(quick: bool) -> Iterator[Measure]:
    """Measure position and light of the sun's disc in the sky."""
    camera = cameras()["MER navcam, CAHVOR, 45 deg"]
    off, flux = [], []
    for azimuth_deg, elevation_deg in (
        ((90.0, 12.0), (97.0, 16.0)) if quick else ((90.0, 12.0), (97.0, 16.0), (80.0, 5.0))
    ):
        sun = Sun(direction(np.radians(azimuth_deg), np.radians(elevation_deg)))
        law = Photometry(sky_share=0.3, sky=DustySky(0.5, 0.95, 0.65))
        pose = rigid(Rotation.identity(), np.array([0.0, 0.0, 1.5]))
        scene = Scene(_flat(), (0.0, 0.0), sun, law, mesh_finest_m=0.5, mesh_reach_m=2000.0)
        rays = PixelRays.of(camera)
        radiance = renderer().render(scene, rays, pose).radiance.astype(np.float64)
        light = np.where(radiance > 1000.0, radiance, 0.0)
        rows, columns = np.indices(radiance.shape)
        centre = np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()
        off.append(float(np.linalg.norm(centre - camera.project(1e9 * sun.direction)[0])))
        angle = np.square(rays.pixel_angles.astype(np.float64)).reshape(radiance.shape)
        flux.append(abs(float((light * angle).sum()) / np.pi - 1.0))
    claim = "the sun's disc from the sun's direction"
    yield Measure(claim, max(off), "px", find_limit(claim), f"{len(off)} suns in the navcam's sky")
    claim = "light of the sun's disc from the direct sun"
    yield Measure(claim, max(flux), "", find_limit(claim), "the same pictures")


CHECKS = (
    Check("opposition", "Light", run_opposition),
    Check("shadows", "Light", run_shadows),
    Check("reflectance", "Light", run_reflectance),
    Check("clouds", "Light", run_clouds),
    Check("sun", "Light", run_sun),
)
