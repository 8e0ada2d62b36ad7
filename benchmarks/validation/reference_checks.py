"""Check of rendering against the independent renderer Mitsuba 3, with the same rays, sun and Lambertian ground.

Needs the extra `validate`. Mitsuba renders the triangles of objects and a mesh of the spline surface of the ground,
finer than its samples, with interpolated normals. Both renderers use the same rays.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Float64
from scipy import ndimage

from benchmarks.validation.light_checks import FLAT_ALBEDO, make_uniform
from benchmarks.validation.motion import View, render
from benchmarks.validation.records import Check, Measure
from benchmarks.validation.scenes import descent_conditions, descent_view, renderer
from marsyard.sim.frames import direction
from marsyard.sim.render import Frame, Sun
from marsyard.sim.terrain import Surface

#: Maximum relative difference of radiances that are considered equal.
MAX_RELATIVE_DIFFERENCE = 0.01
#: Distance from a shadow's edge, pixels, within which radiance is not compared.
EDGE_PX = 1
#: Vertices of the mesh per terrain sample. With 5, linear normals cause differences of 1 % if the sun is at 10 deg.
VERTICES_PER_SAMPLE = 9


def make_ground_mesh(
    surface: Surface, low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, their normals, and triangles of a rectangle of the surface."""
    step = surface.spacing_m / VERTICES_PER_SAMPLE
    x, y = (np.arange(low[axis], high[axis], step) for axis in (0, 1))
    east, north = (grid.ravel() for grid in np.meshgrid(x, y))
    vertices = np.column_stack([east, north, surface.height(east, north)])
    normals = np.column_stack([-surface.gradient(east, north, 0), np.ones(east.size)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    corner = (np.arange(len(y) - 1)[:, None] * len(x) + np.arange(len(x) - 1)).ravel()
    right, above = corner + 1, corner + len(x)
    faces = np.concatenate([np.column_stack([corner, right, above]), np.column_stack([right, above + 1, above])])
    return vertices, normals, faces


def _load_mesh(mi: Any, path: Path, vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> Any:
    """Load a mesh with interpolated normals from a PLY file; other interfaces need a newer LLVM than Debian's."""
    mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False, validate=False)
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=True))
    reflectance = {"type": "uniform", "value": FLAT_ALBEDO}
    bsdf = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": reflectance}}
    return mi.load_dict({"type": "ply", "filename": str(path), "bsdf": bsdf})


def render_reference(
    view: View, frame: Frame
) -> tuple[Float[np.ndarray, "rows columns"], Bool[np.ndarray, "rows columns"]]:
    """Compute the radiance factor along the rays of a frame with Mitsuba, and whether the points are in cast shadow."""
    import mitsuba as mi

    # one ray at a time: the vector variants of Mitsuba 3.9 abort with LLVM 15
    mi.set_variant("scalar_rgb")
    sun = np.asarray(view.scene.sun.direction, dtype=np.float64)
    points = frame.points_world().reshape(-1, 3)
    visible = points[np.isfinite(points).all(axis=1)]
    # maximum horizontal distance to ground that shades a point: height range of the terrain / tan(sun elevation)
    shadow_offset = np.ptp(view.scene.surface.levels[0][..., 0]) / sun[2] * sun[:2]
    low = np.minimum(visible[:, :2].min(axis=0), (visible[:, :2] + np.minimum(shadow_offset, 0.0)).min(axis=0)) - 5.0
    high = np.maximum(visible[:, :2].max(axis=0), (visible[:, :2] + np.maximum(shadow_offset, 0.0)).max(axis=0)) + 5.0
    # coordinates relative to the mean visible point, because Mitsuba uses single precision
    origin = visible.mean(axis=0)
    vertices, normals, faces = make_ground_mesh(view.scene.surface, low, high)
    objects = view.scene.objects
    corner_positions = objects.triangles.reshape(-1, 3) - origin
    vertex_indices = np.arange(len(corner_positions)).reshape(-1, 3)
    with tempfile.TemporaryDirectory() as folder:
        shapes = {"ground": _load_mesh(mi, Path(folder) / "ground.ply", vertices - origin, normals, faces)}
        if len(objects):
            path = Path(folder) / "objects.ply"
            shapes["objects"] = _load_mesh(mi, path, corner_positions, objects.normals.reshape(-1, 3), vertex_indices)
    # with the irradiance pi, the radiance equals the radiance factor
    light = {"type": "directional", "direction": list(-sun), "irradiance": {"type": "uniform", "value": np.pi}}
    scene = mi.load_dict({"type": "scene", "light": light, **shapes})
    pose, rays = frame.world_from_body, frame.rays
    starts = pose.apply(rays.centre + rays.origins.reshape(-1, 3)) - origin
    directions = pose.rotation.apply(rays.directions.reshape(-1, 3).astype(np.float64))
    sampler = mi.load_dict({"type": "independent", "sample_count": 1})
    sampler.seed(1)
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0, "hide_emitters": True})
    radiance, shadow = np.zeros(len(starts)), np.zeros(len(starts), dtype=np.bool_)
    for number, (start, towards) in enumerate(zip(starts.tolist(), directions.tolist(), strict=True)):
        ray = mi.Ray3f(start, towards)
        radiance[number] = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))[0][0]
        hit = scene.ray_intersect(ray)
        shadow[number] = hit.is_valid() and scene.ray_test(hit.spawn_ray(sun.tolist()))
    return radiance.reshape(frame.radiance.shape), shadow.reshape(frame.radiance.shape)


def _compare(name: str, view: View, sun: Sun) -> Iterator[Measure]:
    """Measure the fractions of pixels with equal radiance and with equal shadows."""
    view = make_uniform(view, sun)
    frame = render(renderer(), view)
    reference, in_shadow = render_reference(view, frame)
    faces_sun = frame.normal @ np.asarray(sun.direction) > 0.0
    lit = frame.radiance > 0.0
    reference_lit = reference > 0.0
    is_near_edge = ndimage.binary_dilation(
        ndimage.maximum_filter(reference_lit, 3) != ndimage.minimum_filter(reference_lit, 3), iterations=EDGE_PX
    )
    difference = np.abs(frame.radiance - reference)
    # the tolerance of dark pixels is absolute: that of a radiance factor of 2 % of the albedo
    is_equal = difference <= MAX_RELATIVE_DIFFERENCE * np.maximum(reference, 0.02 * FLAT_ALBEDO)
    how = (
        f"{is_equal.size:,} pixels, {np.mean(is_near_edge):.1%} near a shadow's edge, "
        f"{np.mean(in_shadow & faces_sun):.1%} in cast shadow; median difference "
        f"{np.median(difference[~is_near_edge] / np.maximum(reference[~is_near_edge], 1e-3)):.2%}"
    )
    claim = f"radiance within 1 % of Mitsuba's: {name}"
    yield Measure(claim, float(np.mean(is_equal[~is_near_edge])), "", 0.995, how, "at least")
    yield Measure(f"shadows as Mitsuba's: {name}", float(np.mean(lit == reference_lit)), "", 0.995, how, "at least")


def run_reference(quick: bool) -> Iterator[Measure]:
    """Compare descent images pixel by pixel."""
    size = (256, 256) if quick else (512, 512)
    for site, height_m, elevation_deg in (("gusev", 300.0, 35.0), ("pisgah", 300.0, 20.0), ("pisgah", 300.0, 10.0)):
        sun = Sun(direction(np.radians(110.0), np.radians(elevation_deg)))
        name = f"{site} from {height_m:g} m, sun at {elevation_deg:g} deg"
        yield from _compare(name, descent_view(site, height_m, size), sun)


CHECKS = (
    Check(
        "reference",
        "Independent renderer",
        run_reference,
        conditions=tuple(
            descent_conditions(f"*{name} from 300 m, sun at {sun:g} deg", name, 300.0, sun)
            for name, sun in (("gusev", 35.0), ("pisgah", 20.0), ("pisgah", 10.0))
        ),
    ),
)
