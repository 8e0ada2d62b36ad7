"""Scenes and cameras of the checks."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.validation.motion import View
from marsyard.sim.camera import Cahv, Cahvore, CameraModel, read_camera
from marsyard.sim.frames import direction, rigid
from marsyard.sim.render import Objects, Photometry, Renderer, Scene, Sun, Texture, process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.sim.sensor.presets import preset
from marsyard.sim.terrain import Surface, TerrainBank, TerrainParameters, synthesise
from marsyard.sim.terrain.imported import RealTerrain
from marsyard.sim.terrain.rocks import PlacedRock, RockField, RockParameters
from marsyard.sim.terrain.sites import Site, SiteTexture, site

#: Seed of the terrain bank of the checks.
SEED = 20
HAZCAM_LABEL = Path(__file__).parents[3] / "shared/data/mer_opportunity/1F483288473EFFCMUFP1214L0M1.IMG"
#: HiRISE tile in Gale: 1 m posts, 0.5 m orthoimage.
TILE = Path(__file__).parents[3] / "shared/data/gale_hirise/gale_1m_dem_0p5m_ortho.npz"
#: Arbitrary position of the descents, metres.
DESCENT_PLACE = (1000.0, 1200.0)
#: Position and size of the large rock, and height of the mast camera.
ROCK_PLACE, ROCK_DIAMETER_M, MAST_M = (50.0, 50.0), 2.5, 1.6
#: Lambertian ground without skylight.
PAINT = Photometry(lunar_fraction=0.0, surge_amplitude=0.0, sky_share=0.0)
OVERHEAD = Sun(np.array([0.0, 0.0, 1.0]))


def renderer() -> Renderer:
    return process_renderer(default_backend())


def forward(camera: CameraModel) -> CameraModel:
    """Move the camera to the origin of the body frame."""
    return camera.transform(rigid(Rotation.identity(), -np.asarray(camera.c)))


def make_hazcam() -> Cahvore:
    """A 124 deg camera similar to the MER hazcams, with a moving entrance pupil, if no image label is available."""
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


def label_hazcam() -> CameraModel | None:
    """Opportunity's front hazcam from an image label, at the origin of the body frame; None without the file."""
    if not HAZCAM_LABEL.exists():
        return None
    # rover axes: x forward, y right, z down
    turned = rigid(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])), np.zeros(3))
    return forward(read_camera(HAZCAM_LABEL).transform(turned))


def cameras() -> dict[str, CameraModel]:
    """All types of cameras, in body axes."""
    made: dict[str, CameraModel | None] = {
        "MER descent camera, CAHVOR, 45 deg": preset("mer-descent-flown").cameras()[0],
        "MER navcam, CAHVOR, 45 deg": forward(preset("mer-navcam").cameras()[0]),
        "hazcam, CAHVORE, 124 deg": make_hazcam(),
        "Opportunity's hazcam from its label, CAHVORE, 124 deg": label_hazcam(),
        "research pancam, 16 mm": forward(preset("research-pancam").cameras()[0]),
        "Sony XC-55": preset("xc-55").cameras()[0],
    }
    return {name: camera for name, camera in made.items() if camera is not None}


def looks_down(camera: CameraModel) -> bool:
    return bool(camera.boresight()[2] < -0.9)


def level_pose(position: np.ndarray) -> RigidTransform:
    return rigid(Rotation.identity(), position)


def law_of(where: Site) -> Photometry:
    given = where.photometry
    return Photometry(
        lunar_fraction=given.lunar_fraction, surge_amplitude=given.surge_amplitude, surge_width=given.surge_width
    )


def texture_of(given: SiteTexture) -> Texture:
    return Texture(given.coarsest_m, given.amplitudes)


@cache
def descent_surface(name: str) -> Surface:
    return TerrainBank(site(name).terrain("descent"), SEED).terrain(0)


@cache
def ground_surface(name: str) -> Surface:
    return TerrainBank(site(name).terrain("ground"), SEED).terrain(0)


def rocks(
    surface: Surface,
    parameters: RockParameters | None,
    place: tuple[float, float],
    reach_m: float,
    above_m: float,
    albedo: float,
) -> Objects:
    """Rocks around a position."""
    if parameters is None:
        return Objects.none()
    field = RockField.on(surface, parameters, np.random.default_rng(SEED))
    mesh = field.near(*place, reach_m, above_m=above_m)
    return Objects.of_mesh(mesh.vertices, mesh.vertex_normals, mesh.faces, mesh.rock_of_face, albedo=albedo)


def tile_view(height_m: float, size: tuple[int, int]) -> View | None:
    """Centre of the descent camera's image of the HiRISE tile in Gale with orthoimage; None without the data."""
    if not TILE.exists():
        return None
    # the orthoimage is shifted by about 2 m east and 1 m south; detail below the 1 m posts is synthetic
    source = RealTerrain(dtm=TILE, ortho_east_m=2.0, ortho_north_m=-1.0)
    terrain = TerrainParameters(samples=2048, spacing_m=0.25, craters_per_km2=0.0, source=source)
    surface = synthesise(terrain, np.random.default_rng(SEED))
    middle = (0.5 * 2048 * 0.25, 0.5 * 2048 * 0.25)
    whole = preset("mer-descent-flown").cameras()[0]
    camera = whole.crop((whole.size[0] - size[0]) // 2, (whole.size[1] - size[1]) // 2, size)
    scene = Scene(
        surface,
        middle,
        Sun(direction(np.radians(110.0), np.radians(40.0))),
        Photometry(),
        mesh_finest_m=0.0085 * height_m,
        mesh_reach_m=14.0 * height_m,
    )
    place = np.array([*middle, float(surface.height(*middle)) + height_m])
    return View(scene, camera, rigid(Rotation.from_euler("xy", [4.0, -3.0], degrees=True), place))


def descent_view(name: str, height_m: float, size: tuple[int, int]) -> View:
    """Centre of the descent camera's image of a site from a height, slightly tilted."""
    where, surface = site(name), descent_surface(name)
    whole = preset("mer-descent-flown").cameras()[0]
    camera = whole.crop((whole.size[0] - size[0]) // 2, (whole.size[1] - size[1]) // 2, size)
    scene = Scene(
        surface,
        DESCENT_PLACE,
        Sun(direction(np.radians(110.0), np.radians(40.0))),
        law_of(where),
        rocks(
            surface,
            where.terrain("descent").rocks,
            DESCENT_PLACE,
            0.5 * height_m,
            height_m,
            where.photometry.rock_albedo,
        ),
        ground_texture=texture_of(where.ground_texture),
        object_texture=texture_of(where.rock_texture),
    )
    ground = float(surface.height(*DESCENT_PLACE))
    tilt = Rotation.from_euler("zyx", [20.0, 5.0, -4.0], degrees=True)
    return View(scene, camera, rigid(tilt, np.array([*DESCENT_PLACE, ground + height_m])))


def rock_view(name: str, distance_m: float, size: tuple[int, int] | None = None) -> View:
    """A large rock among others, from a mast; `distance_m` is the distance from the camera to the rock's near side."""
    where, surface = site(name), ground_surface(name)
    ground = float(surface.height(*ROCK_PLACE))
    # the near side is about half a diameter from the centre
    away = np.sqrt(max(distance_m**2 - 0.5 * MAST_M**2, 0.0)) + 0.4 * ROCK_DIAMETER_M
    eye = np.array([ROCK_PLACE[0] - away, ROCK_PLACE[1], ground + MAST_M])
    target = PlacedRock(
        name="target", east_m=ROCK_PLACE[0], north_m=ROCK_PLACE[1], diameter_m=ROCK_DIAMETER_M, shape=3, yaw_deg=20.0
    )
    parameters = (where.terrain("ground").rocks or RockParameters()).model_copy(update={"placed": (target,)})
    objects = rocks(surface, parameters, (eye[0], eye[1]), away + 6.0, MAST_M, where.photometry.rock_albedo)
    whole = forward(preset("research-pancam").cameras()[0])
    if size is None:
        size = whole.size
    camera = whole.crop((whole.size[0] - size[0]) // 2, (whole.size[1] - size[1]) // 2, size)
    scene = Scene(
        surface,
        (eye[0], eye[1]),
        Sun(direction(np.radians(200.0), np.radians(40.0))),
        law_of(where),
        objects,
        ground_texture=texture_of(where.ground_texture),
        object_texture=texture_of(where.rock_texture),
        mesh_finest_m=0.04,
        mesh_reach_m=600.0,
        mesh_lines=641,
        among_objects=True,
    )
    down = np.arctan2(MAST_M - 0.3 * ROCK_DIAMETER_M, away - 0.3 * ROCK_DIAMETER_M)
    return View(scene, camera, rigid(Rotation.from_euler("y", down), eye))


def ground_view(name: str) -> View:
    """Ground without rocks, from a mast camera pitched down by 20 deg."""
    surface, where = ground_surface(name), site(name)
    eye = np.array([*ROCK_PLACE, float(surface.height(*ROCK_PLACE)) + MAST_M])
    scene = Scene(
        surface,
        ROCK_PLACE,
        Sun(direction(np.radians(200.0), np.radians(40.0))),
        law_of(where),
        ground_texture=texture_of(where.ground_texture),
        mesh_finest_m=0.04,
        mesh_reach_m=600.0,
        mesh_lines=641,
        among_objects=True,
    )
    camera = forward(preset("mer-navcam").cameras()[0])
    return View(scene, camera, rigid(Rotation.from_euler("y", 20.0, degrees=True), eye))
