"""Scenes, cameras and views (scene, camera and camera pose) for the validation checks of the renderer.

World axes: x east, y north, z up. Body axes of a camera on a mast: x forward, y left, z up.
"""

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.validation.motion import View
from marsyard.reports.validation_rows import Conditions
from marsyard.sim.camera import Cahv, Cahvore, CameraModel, read_camera
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Objects, Photometry, Renderer, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.sensor.presets import preset
from marsyard.sim.terrain import Surface, TerrainBank, TerrainParameters, synthesise
from marsyard.sim.terrain.rasters import RealTerrain
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from marsyard.sim.terrain.sites import Site, SiteTexture, site

#: Seed of the terrain bank of the checks.
SEED = 20
#: Image of Opportunity's front hazcam, whose label contains the camera model.
HAZCAM_LABEL = Path(__file__).parents[3] / "shared/data/mer_opportunity/1F483288473EFFCMUFP1214L0M1.IMG"
#: HiRISE tile in Gale: 1 m posts, 0.5 m orthoimage.
TILE = Path(__file__).parents[3] / "shared/data/gale_hirise/gale_1m_dem_0p5m_ortho.npz"
#: Horizontal position (x, y) of the camera in all descent views, m; the choice is arbitrary.
DESCENT_POSITION = (1000.0, 1200.0)
#: Position and diameter of the large rock, and height of the mast camera, metres.
ROCK_POSITION, ROCK_DIAMETER_M, MAST_M = (50.0, 50.0), 2.5, 1.6
#: Lambertian ground without skylight.
LAMBERTIAN = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_fraction=0.0)
#: Systems whose images are taken in a descent, from a mast, and from a helicopter or a lander near the ground.
DESCENT, MAST, LANDING = ("dimes", "fieldtest", "localisation"), ("vtt",), ("hda",)
#: Conditions of rows on one of the `cameras`, whose name ends the claim or precedes the backend.
CAMERA_CONDITIONS = (
    Conditions("*MER descent camera*", (*DESCENT, *LANDING), camera=("mer-descent-flown",)),
    Conditions("*MER navcam*", MAST, camera=("mer-navcam",)),
    Conditions("*hazcam*", MAST),
    Conditions("*research pancam*", MAST, camera=("research-pancam",)),
    Conditions("*Sony XC-55*", LANDING, camera=("xc-55",)),
)
#: Camera of all descent views.
FLOWN_CAMERA = "mer-descent-flown"
OVERHEAD_SUN = Sun(np.array([0.0, 0.0, 1.0]))


def renderer() -> Renderer:
    """Return the renderer that all checks share."""
    return process_renderer(default_backend())


def move_to_origin(camera: CameraModel) -> CameraModel:
    """Move the camera to the origin of the body frame."""
    return camera.transform(rigid(Rotation.identity(), -np.asarray(camera.c)))


def make_hazcam() -> Cahvore:
    """Create a 124 deg camera similar to the MER hazcams, with a moving entrance pupil."""
    pinhole = Cahv.from_focal_length(
        focal_m=5.58e-3,
        pixel_pitch_m=12e-6,
        size=(1024, 1024),
        centre=np.zeros(3),
        axis=np.array([1.0, 0.0, 0.0]),
        right=np.array([0.0, -1.0, 0.0]),
    )
    return Cahvore.from_cahv(
        pinhole, r=np.array([0.0, -0.02, 0.002]), e=np.array([0.006, 0.006, 0.006]), linearity=-0.1
    )


def read_hazcam() -> CameraModel | None:
    """Read Opportunity's front hazcam from an image label, at the origin of the body frame; None without the file."""
    if not HAZCAM_LABEL.exists():
        return None
    # rover axes: x forward, y right, z down
    body_from_rover = rigid(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
    return move_to_origin(read_camera(HAZCAM_LABEL).transform(body_from_rover))


def cameras() -> dict[str, CameraModel]:
    """Return one camera of each type, in body axes, by name."""
    by_name: dict[str, CameraModel | None] = {
        "MER descent camera, CAHVOR, 45 deg": preset("mer-descent-flown").cameras()[0],
        "MER navcam, CAHVOR, 45 deg": move_to_origin(preset("mer-navcam").cameras()[0]),
        "hazcam, CAHVORE, 124 deg": make_hazcam(),
        "Opportunity's hazcam from its label, CAHVORE, 124 deg": read_hazcam(),
        "research pancam, 16 mm": move_to_origin(preset("research-pancam").cameras()[0]),
        "Sony XC-55": preset("xc-55").cameras()[0],
    }
    return {name: camera for name, camera in by_name.items() if camera is not None}


def level_pose(position: np.ndarray) -> RigidTransform:
    """Return the pose of a level body at a position."""
    return rigid(Rotation.identity(), position)


def create_photometry(site_parameters: Site) -> Photometry:
    """Return the reflectance law of a site."""
    parameters = site_parameters.photometry
    return Photometry(
        lunar_fraction=parameters.lunar_fraction,
        surge_amplitude=parameters.surge_amplitude,
        surge_width=parameters.surge_width,
    )


def create_texture(parameters: SiteTexture) -> Texture:
    """Return the albedo texture of a site."""
    return Texture(parameters.coarsest_m, parameters.amplitudes)


@cache
def descent_surface(name: str) -> Surface:
    """Return the terrain of a site for descent images."""
    return TerrainBank(site(name).terrain("descent"), SEED).terrain(0)


@cache
def ground_surface(name: str) -> Surface:
    """Return the terrain of a site for mast images."""
    return TerrainBank(site(name).terrain("ground"), SEED).terrain(0)


def create_rocks(
    surface: Surface,
    parameters: RockParameters | None,
    centre: tuple[float, float],
    radius_m: float,
    above_m: float,
    albedo: float,
) -> Objects:
    """Create the rocks within `radius_m` of a horizontal position, as seen by a camera `above_m` above the ground."""
    if parameters is None:
        return Objects.none()
    field = RockField.draw(surface, parameters, np.random.default_rng(SEED))
    mesh = field.near(*centre, radius_m, above_m=above_m)
    return Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, albedo=albedo)


def crop_centre(camera: CameraModel, size: tuple[int, int]) -> CameraModel:
    """Return the camera of the central `size` (columns, rows) pixels of the image."""
    return camera.crop((camera.size[0] - size[0]) // 2, (camera.size[1] - size[1]) // 2, size)


def tile_view(height_m: float, size: tuple[int, int]) -> View | None:
    """View of the HiRISE tile in Gale with its orthoimage: central crop of a descent image; None without the data."""
    if not TILE.exists():
        return None
    # the orthoimage is shifted by about 2 m east and 1 m south; detail below the 1 m posts is synthetic
    source = RealTerrain(dtm=TILE, ortho_east_m=2.0, ortho_north_m=-1.0)
    terrain = TerrainParameters(samples=2048, spacing_m=0.25, craters_per_km2=0.0, source=source)
    surface = synthesise(terrain, np.random.default_rng(SEED))
    centre = (0.5 * 2048 * 0.25, 0.5 * 2048 * 0.25)
    camera = crop_centre(preset("mer-descent-flown").cameras()[0], size)
    # the default mesh of a scene is for a height of about 1400 m; its lengths are scaled with the height
    scene = Scene(
        surface,
        centre,
        Sun(direction(np.radians(110.0), np.radians(40.0))),
        Photometry(),
        mesh_finest_m=0.0085 * height_m,
        mesh_half_width_m=14.0 * height_m,
    )
    eye = np.array([*centre, float(surface.height(*centre)) + height_m])
    return View(scene, camera, rigid(Rotation.from_euler("xy", [4.0, -3.0], degrees=True), eye))


def descent_view(name: str, height_m: float, size: tuple[int, int]) -> View:
    """View of a site from a height above the ground: central crop of a slightly tilted descent image."""
    site_parameters, surface = site(name), descent_surface(name)
    camera = crop_centre(preset("mer-descent-flown").cameras()[0], size)
    scene = Scene(
        surface,
        DESCENT_POSITION,
        Sun(direction(np.radians(110.0), np.radians(40.0))),
        create_photometry(site_parameters),
        create_rocks(
            surface,
            site_parameters.terrain("descent").rocks,
            DESCENT_POSITION,
            0.5 * height_m,
            height_m,
            site_parameters.photometry.rock_albedo,
        ),
        ground_texture=create_texture(site_parameters.ground_texture),
        object_texture=create_texture(site_parameters.rock_texture),
    )
    ground = float(surface.height(*DESCENT_POSITION))
    tilt = Rotation.from_euler("zyx", [20.0, 5.0, -4.0], degrees=True)
    return View(scene, camera, rigid(tilt, np.array([*DESCENT_POSITION, ground + height_m])))


def rock_view(name: str, distance_m: float, size: tuple[int, int] | None = None) -> View:
    """View of a large rock from a mast; `distance_m` is the distance from the camera to the near side of the rock."""
    site_parameters, surface = site(name), ground_surface(name)
    ground = float(surface.height(*ROCK_POSITION))
    # approximation: the near side is 0.4 diameters from the rock's centre and sqrt(0.5) mast heights below the camera
    ground_distance_m = np.sqrt(max(distance_m**2 - 0.5 * MAST_M**2, 0.0)) + 0.4 * ROCK_DIAMETER_M
    eye = np.array([ROCK_POSITION[0] - ground_distance_m, ROCK_POSITION[1], ground + MAST_M])
    target = PlacedRock(
        name="target",
        east_m=ROCK_POSITION[0],
        north_m=ROCK_POSITION[1],
        diameter_m=ROCK_DIAMETER_M,
        shape=3,
        yaw_deg=20.0,
    )
    rocks = (site_parameters.terrain("ground").rocks or RockParameters()).model_copy(update={"placed": (target,)})
    radius_m, albedo = ground_distance_m + 6.0, site_parameters.photometry.rock_albedo
    objects = create_rocks(surface, rocks, (eye[0], eye[1]), radius_m, MAST_M, albedo)
    full_camera = move_to_origin(preset("research-pancam").cameras()[0])
    if size is None:
        size = full_camera.size
    camera = crop_centre(full_camera, size)
    scene = Scene(
        surface,
        (eye[0], eye[1]),
        Sun(direction(np.radians(200.0), np.radians(40.0))),
        create_photometry(site_parameters),
        objects,
        ground_texture=create_texture(site_parameters.ground_texture),
        object_texture=create_texture(site_parameters.rock_texture),
        mesh_finest_m=0.04,
        mesh_half_width_m=600.0,
        mesh_lines=641,
        among_objects=True,
    )
    # the camera points at 0.3 diameters above the ground, 0.3 diameters in front of the rock's centre
    pitch_rad = np.arctan2(MAST_M - 0.3 * ROCK_DIAMETER_M, ground_distance_m - 0.3 * ROCK_DIAMETER_M)
    return View(scene, camera, rigid(Rotation.from_euler("y", pitch_rad), eye))


def descent_conditions(rows: str, name: str, height_m: float, sun_deg: float | None = None) -> Conditions:
    """Conditions of rows with views of a site from a height, without haze; `sun_deg` is the sun's elevation."""
    sun, slope = None if sun_deg is None else (sun_deg, sun_deg), site(name).terrain("descent").rms_slope_deg
    return Conditions(
        rows,
        DESCENT,
        site=(name,),
        camera=(FLOWN_CAMERA,),
        sun_elevation_deg=sun,
        slope_deg=(slope, slope),
        range_m=(height_m, height_m),
    )


def ground_view(name: str) -> View:
    """View of ground without rocks, from a mast camera pitched down by 20 deg."""
    surface, site_parameters = ground_surface(name), site(name)
    eye = np.array([*ROCK_POSITION, float(surface.height(*ROCK_POSITION)) + MAST_M])
    scene = Scene(
        surface,
        ROCK_POSITION,
        Sun(direction(np.radians(200.0), np.radians(40.0))),
        create_photometry(site_parameters),
        ground_texture=create_texture(site_parameters.ground_texture),
        mesh_finest_m=0.04,
        mesh_half_width_m=600.0,
        mesh_lines=641,
        among_objects=True,
    )
    camera = move_to_origin(preset("mer-navcam").cameras()[0])
    return View(scene, camera, rigid(Rotation.from_euler("y", 20.0, degrees=True), eye))
