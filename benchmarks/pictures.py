"""Pictures near the ground, beside pyrender's own, and a worker's memory."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.timing import Figure, core_seconds
from scenarios.descent import CameraParameters, DescentScenarioParameters, camera_optics, flown_descent
from scenarios.views import Eye, SiteGround, nadir_pose, site_scene
from sim.camera import Cahv, Cahvor
from sim.frames import direction, rigid
from sim.render import Objects, Photometry, PixelRays, Scene, Sun, Texture, process_renderer
from sim.render.backend import compile_shaders_once, default_backend
from sim.render.mesh import graded_offsets, ground_mesh
from sim.render.rays import VIEW_SIDE_PX
from sim.sensor import Detector, DetectorParameters
from sim.streams import Streams
from sim.terrain import Surface, TerrainBank, TerrainParameters, synthesise
from sim.terrain.rocks import RockField, RockParameters
from sim.terrain.sites import site

SUN = Sun(direction(4.0, 0.7))


def descent_scene() -> tuple[Scene, Surface]:
    """The descent scene of the smoke campaign."""
    surface = TerrainBank(TerrainParameters(), 1).terrain(0)
    return Scene(surface, (0.0, 0.0), SUN, Photometry()), surface


def descent_exposure() -> Callable[[], object]:
    """What renders and exposes a picture of the descent scene, its terrain and its shadow built once."""
    scene, surface = descent_scene()
    optics = camera_optics(CameraParameters())
    renderer = process_renderer(default_backend())
    pose = descent_pose(surface)
    detector = Detector.drawn(optics.fall_off, DetectorParameters(), np.random.default_rng(0))
    return lambda: detector.expose(renderer.render(scene, optics.rays, pose).radiance, np.random.default_rng(0))


def descent_pose(surface: Surface) -> RigidTransform:
    """Where the lander of the descent scene is a second after its first picture."""
    flown = flown_descent(DescentScenarioParameters(), surface, Streams(1, "bench", 0))
    return flown.motion.state(1.0).world_from_body


def beside_pyrender(repeats: int) -> list[Figure]:
    """A sensor-realistic descent frame against pyrender's own shaded frame of the same ground, in turn.

    Ours shows the terrain's samples, 1.5 m apart, whatever the mesh that starts the search; pyrender shows what its
    mesh holds. It gets a mesh with lines 3 m apart in the middle, twice as coarse as the terrain still, and casts
    shadows, as ours does.
    """
    ours = descent_exposure()
    scene, surface = descent_scene()
    focal_px = float(camera_optics(CameraParameters()).rays.focal_px[0])
    theirs = _pyrender_shaded(scene, descent_pose(surface).as_matrix() @ _camera_to_gl(), focal_px)
    paired = [(core_seconds(ours, 1)[0], core_seconds(theirs, 1)[0]) for _ in range(repeats)]
    return [
        Figure("descent frame with shadows and detector", [mine for mine, _ in paired], bar=0.3),
        Figure("pyrender's shaded frame of a mesh as fine, with shadows", [other for _, other in paired]),
        Figure("how many times slower that is", [other / mine for mine, other in paired], least=3.0),
    ]


def _camera_to_gl() -> np.ndarray:
    """The descent camera looks along the body's -z with columns to +x: OpenGL's own camera."""
    return np.eye(4)


def _pyrender_shaded(scene: Scene, pose: np.ndarray, focal_px: float) -> Callable[[], None]:
    import pyrender

    offsets = graded_offsets(scene.mesh_reach_m, 3.0, 1025)
    mesh = ground_mesh(scene.surface, scene.centre_m[0] + offsets, scene.centre_m[1] + offsets)
    theirs = pyrender.Scene(ambient_light=(0.1, 0.1, 0.1))
    theirs.add(pyrender.Mesh.from_trimesh(mesh, smooth=True))
    light = np.eye(4)
    light[:3, :3] = Rotation.align_vectors(SUN.direction[None], np.array([[0.0, 0.0, 1.0]]))[0].as_matrix()
    theirs.add(pyrender.DirectionalLight(intensity=3.0), pose=light)
    middle = VIEW_SIDE_PX / 2.0
    camera = pyrender.IntrinsicsCamera(focal_px, focal_px, middle, middle, znear=100.0, zfar=40000.0)
    theirs.add(camera, pose=pose)
    renderer = pyrender.OffscreenRenderer(VIEW_SIDE_PX, VIEW_SIDE_PX)
    compile_shaders_once(renderer._renderer)
    flags = pyrender.RenderFlags.SHADOWS_DIRECTIONAL
    return lambda: renderer.render(theirs, flags=flags)


def rover_pictures(repeats: int) -> list[Figure]:
    """A navcam frame over rocks, and a stereo pair of subframes of 161 x 161."""
    parameters = TerrainParameters(
        samples=2048, spacing_m=0.05, rms_slope_deg=4.0, slope_baseline_m=1.0, outer_scale_m=20.0, craters_per_km2=0.0
    )
    surface = synthesise(parameters, np.random.default_rng(3))
    rocks = RockField.on(surface, RockParameters(abundance=0.1, smallest_m=0.08), np.random.default_rng(1))
    mesh = rocks.near(50.0, 50.0, 20.0, above_m=1.5)
    scene = Scene(
        surface,
        (50.0, 50.0),
        SUN,
        Photometry(),
        objects=Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, albedo=0.15),
        ground_texture=Texture(0.1, (0.06,) * 7),
        object_texture=Texture(0.2, (0.06,) * 8),
        mesh_finest_m=0.04,
        mesh_reach_m=600.0,
        mesh_lines=641,
        among_objects=True,
    )
    pinhole = Cahv.from_focal_length(
        focal_m=14.67e-3,
        pixel_pitch_m=12e-6,
        size=(1024, 1024),
        axis=np.array([0.0, 1.0, 0.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    navcam = Cahvor.from_cahv(pinhole, r=np.array([0.00096, -0.002183, 0.018547]))
    full, small = PixelRays.of(navcam), PixelRays.of(navcam.cropped(430, 560, (161, 161)))
    eye = np.array([50.0, 50.0, float(surface.height(50.0, 50.0)) + 1.5])
    looking = Rotation.from_euler("x", -18.0, degrees=True)
    left, right = rigid(looking, eye), rigid(looking, eye + np.array([0.2, 0.0, 0.0]))
    renderer = process_renderer(default_backend())

    def pair() -> None:
        renderer.render(scene, small, left)
        renderer.render(scene, small, right)

    return [
        Figure("navcam frame over rocks", core_seconds(lambda: renderer.render(scene, full, left), repeats)),
        Figure("stereo pair of subframes, 161 x 161", core_seconds(pair, 3 * repeats), bar=0.06),
    ]


#: Pictures of each scene of the memory's measurement, and of how many scenes one has rocks.
PICTURES_OF_A_SCENE, ROCKY_OF = 5, 4


def memory(frames: int) -> list[Figure]:
    """Memory of this process after half of some frames, and after all of them; every fifth frame loads a new scene.

    One scene in four stands on a site with rocks, so that bodies too are loaded and released, and the renderer changes
    between drawing ground alone and drawing numbers of triangles.
    """
    renderer = process_renderer(default_backend())
    _, surface = descent_scene()
    optics = camera_optics(CameraParameters())
    rocky = SiteGround.of(site("pisgah"), "descent")
    pixel_rad = float(np.median(optics.rays.pixel_angles))
    sizes = []
    scenes = frames // PICTURES_OF_A_SCENE
    for number in range(scenes):
        east = 40.0 * number
        if number % ROCKY_OF == ROCKY_OF - 1:
            scene, ground = site_scene(rocky, Eye(east, 0.0, 1200.0, pixel_rad), SUN), rocky.surface
        else:
            scene, ground = Scene(surface, (east, 0.0), SUN, Photometry()), surface
        for picture in range(PICTURES_OF_A_SCENE):
            renderer.render(scene, optics.rays, nadir_pose(ground, east, 0.0, 2000.0 - 150.0 * picture))
            sizes.append(_own_gb())
    quarter = len(sizes) // 4
    # medians: what a scene with rocks takes while it is loaded depends on its rocks
    growth = float(np.median(sizes[-quarter:]) - np.median(sizes[quarter : 2 * quarter]))
    return [
        Figure(f"own memory, most over {len(sizes)} frames of {scenes} scenes, GB", [max(sizes)], bar=1.2),
        Figure("its growth from the second quarter of these frames to the last, GB", [growth], bar=0.02),
        Figure(
            "greatest resident memory, terrain files included, GB",
            [resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20],
            bar=1.2,
        ),
    ]


def _own_gb() -> float:
    """Memory that is this process's own: without the pages of terrain files, which all workers share."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024 / 1e9
    raise RuntimeError("the kernel does not tell a process's own memory")


def wall_seconds_of_a_frame(repeats: int) -> list[Figure]:
    """Wall time of one descent frame with its detector when nothing else runs in the process."""
    scene, surface = descent_scene()
    optics = camera_optics(CameraParameters())
    renderer = process_renderer(default_backend())
    pose = descent_pose(surface)
    times = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        renderer.render(scene, optics.rays, pose)
        times.append(time.perf_counter() - start)
    return [Figure("descent frame, wall seconds", times[1:], bar=0.25)]
