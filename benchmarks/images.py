"""Run times of rendered images, and memory of a process that renders."""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks import THREAD_VARIABLES
from benchmarks.timing import Measurement, core_seconds, measure_seconds
from marsyard.algorithms.processes import used_memory
from marsyard.scenarios.descent.flight import create_flight
from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.parameters import DescentCameraParameters, DescentScenarioParameters
from marsyard.scenarios.views import SiteGround, Viewpoint, nadir_pose, site_scene
from marsyard.sim.camera import Cahv, Cahvor
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Objects, Photometry, PixelRays, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.sensor import Detector, DetectorParameters
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank, TerrainParameters, synthesise
from marsyard.sim.terrain.rocks import RockField, RockParameters
from marsyard.sim.terrain.sites import site

#: Sun of all scenes: azimuth and elevation, radians.
SUN = Sun(direction(4.0, 0.7))


def descent_scene() -> tuple[Scene, Surface]:
    """Return the scene and the terrain of the smoke campaign of descents."""
    surface = TerrainBank(TerrainParameters(), 1).terrain(0)
    return Scene(surface, (0.0, 0.0), SUN, Photometry()), surface


def prepare_descent_exposure() -> Callable[[], object]:
    """Return a function that renders and exposes the descent scene with prepared terrain and shadows."""
    scene, surface = descent_scene()
    optics = camera_optics(DescentCameraParameters())
    renderer = process_renderer(default_backend())
    pose = descent_pose(surface)
    detector = Detector.draw(optics.fall_off, DetectorParameters(), np.random.default_rng(0))
    return lambda: detector.expose(renderer.render(scene, optics.rays, pose).radiance, np.random.default_rng(0))


def descent_pose(surface: Surface) -> RigidTransform:
    """Return the pose of the lander one second after its first image."""
    flight = create_flight(DescentScenarioParameters(), surface, Streams(1, "bench", 0))
    return flight.motion.state(1.0).world_from_body


def measure_rover_images(repeats: int) -> list[Measurement]:
    """Measure a navcam frame over rocks, and a stereo pair of subframes of 161 x 161."""
    parameters = TerrainParameters(
        samples=2048, spacing_m=0.05, rms_slope_deg=4.0, slope_baseline_m=1.0, outer_scale_m=20.0, craters_per_km2=0.0
    )
    surface = synthesise(parameters, np.random.default_rng(3))
    rocks = RockField.draw(surface, RockParameters(abundance=0.1, smallest_m=0.08), np.random.default_rng(1))
    mesh = rocks.near(50.0, 50.0, 20.0, above_m=1.5)
    scene = Scene(
        surface,
        (50.0, 50.0),
        SUN,
        Photometry(),
        objects=Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, albedo=0.15),
        # octaves with equal amplitudes, coarsest 0.1 m (ground) and 0.2 m (rocks)
        ground_texture=Texture(0.1, (0.06,) * 7),
        object_texture=Texture(0.2, (0.06,) * 8),
        mesh_finest_m=0.04,
        mesh_half_width_m=600.0,
        mesh_lines=641,
        among_objects=True,
    )
    # a MER navcam 1.5 m above the ground, whose axis points 18 deg below the horizon
    pinhole = Cahv.from_focal_length(
        focal_m=14.67e-3,
        pixel_pitch_m=12e-6,
        size=(1024, 1024),
        axis=np.array([0.0, 1.0, 0.0]),
        right=np.array([1.0, 0.0, 0.0]),
    )
    navcam = Cahvor.from_cahv(pinhole, r=np.array([0.00096, -0.002183, 0.018547]))
    full_frame, subframe = PixelRays.from_camera(navcam), PixelRays.from_camera(navcam.crop(430, 560, (161, 161)))
    viewpoint = np.array([50.0, 50.0, float(surface.height(50.0, 50.0)) + 1.5])
    attitude = Rotation.from_euler("x", -18.0, degrees=True)
    left, right = rigid(attitude, viewpoint), rigid(attitude, viewpoint + np.array([0.2, 0.0, 0.0]))
    renderer = process_renderer(default_backend())

    def render_pair() -> None:
        renderer.render(scene, subframe, left)
        renderer.render(scene, subframe, right)

    return [
        Measurement("navcam frame over rocks", core_seconds(lambda: renderer.render(scene, full_frame, left), repeats)),
        Measurement("stereo pair of subframes, 161 x 161 px each", core_seconds(render_pair, 3 * repeats), limit=0.06),
    ]


#: Images per scene in the measurement of memory; every fourth scene has rocks.
IMAGES_PER_SCENE, ROCKS_EVERY = 5, 4


def measure_memory(frames: int) -> list[Measurement]:
    """Measure maximum and growth of the memory of this process while it renders many scenes.

    Every fourth scene has rocks, so that meshes are loaded and released, and the renderer switches between drawing only
    the ground and drawing triangle numbers. `frames` is the number of images.
    """
    renderer = process_renderer(default_backend())
    _, surface = descent_scene()
    optics = camera_optics(DescentCameraParameters())
    rocks = SiteGround.from_site(site("pisgah"), "descent")
    memory_gb = []
    scenes = frames // IMAGES_PER_SCENE
    for number in range(scenes):
        east = 40.0 * number
        if number % ROCKS_EVERY == ROCKS_EVERY - 1:
            viewpoint = Viewpoint(east, 0.0, 1200.0, optics.rays.pixel_rad)
            scene, ground = site_scene(rocks, viewpoint, SUN), rocks.surface
        else:
            scene, ground = Scene(surface, (east, 0.0), SUN, Photometry()), surface
        for image in range(IMAGES_PER_SCENE):
            renderer.render(scene, optics.rays, nadir_pose(ground, east, 0.0, 2000.0 - 150.0 * image))
            memory_gb.append(used_memory([os.getpid()]) / 1e9)
    quarter = len(memory_gb) // 4
    # medians, because the memory of scenes with rocks varies
    growth_gb = float(np.median(memory_gb[-quarter:]) - np.median(memory_gb[quarter : 2 * quarter]))
    return [
        Measurement(
            f"maximum memory without terrain files, {len(memory_gb)} frames of {scenes} scenes (GB)",
            [max(memory_gb)],
            limit=1.2,
        ),
        Measurement(
            "growth of this memory from the second to the last quarter of the frames (GB)", [growth_gb], limit=0.02
        ),
        Measurement(
            "maximum resident memory with terrain files (GB)",
            [resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20],
            limit=1.2,
        ),
    ]


def measure_all_cores(repeats: int) -> list[Measurement]:
    """Measure the wall-clock time of a descent frame with detector in a separate process that uses all cores."""
    environment = os.environ | dict.fromkeys(THREAD_VARIABLES, str(os.cpu_count()))
    result = subprocess.run(
        [sys.executable, "-m", "benchmarks.images", str(repeats)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return [
        Measurement(
            "descent frame with shadows and detector, all cores (wall s)", json.loads(result.stdout), limit=0.12
        )
    ]


if __name__ == "__main__":
    print(json.dumps(measure_seconds(prepare_descent_exposure(), int(sys.argv[1]), time.perf_counter)))
