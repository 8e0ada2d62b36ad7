"""Writer of folders for the task `map` of `marsyard ingest`: images of synthetic terrain, and its map."""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from marsyard.scenarios.measured.ingest import ingest
from marsyard.scenarios.measured.store import CasesFile
from marsyard.sim.camera import write_cahvor
from marsyard.sim.frames import rigid
from tests.algorithms.localisation.synthetic_map import MAP_PIXEL_M, Scene, make_camera, make_scene, trace_image

#: Pixels of the camera and of the map along each side.
PIXELS, MAP_PIXELS = 256, 512
CAMERA = make_camera(PIXELS)
#: Heights, m: image pixels of 4.5 to 9 m at nadir for map pixels of 6 m; tilts by up to 10 deg, any heading.
POSES = {
    "high": rigid(Rotation.from_euler("ZX", [40.0, 6.0], degrees=True), np.array([60.0, -90.0, 1400.0])),
    "middle": rigid(Rotation.from_euler("ZX", [-120.0, -10.0], degrees=True), np.array([-150.0, 40.0, 1050.0])),
    "low": rigid(Rotation.from_euler("ZY", [200.0, 3.0], degrees=True), np.array([20.0, 130.0, 700.0])),
}
#: Counts of the brightness 1 in images and map.
_COUNTS = 1200.0


def map_scene(seed: int = 1) -> Scene:
    """Return the terrain: relief of 40 m (standard deviation) in a square of 3 km."""
    return make_scene(seed, MAP_PIXELS, 40.0)


def write_map_folder(folder: Path, scene: Scene, poses: dict[str, RigidTransform], parameters: str = "") -> Path:
    """Write images of 12 bits from poses of the body, the map with its elevations, and the parameters."""
    folder.mkdir(exist_ok=True)
    for name, pose in poses.items():
        radiance = trace_image(scene, CAMERA, np.array(pose.translation), pose.rotation)
        cv2.imwrite(str(folder / f"{name}.png"), np.clip(np.rint(_COUNTS * radiance), 0, 4095).astype(np.uint16))
    write_map(folder, scene)
    write_cahvor(CAMERA, folder / "camera.cahvor")
    (folder / "ingest.toml").write_text(f"""name = "flight"
task = "map"
{parameters}
[camera]
file = "camera.cahvor"
[detector]
bits = 12
[map]
file = "map.png"
pixel_m = {MAP_PIXEL_M}
elevation = "elevation.npy"
""")
    (folder / "images.csv").write_text("case,file\n" + "".join(f"{name},{name}.png\n" for name in poses))
    return folder


def write_map(folder: Path, scene: Scene) -> None:
    """Write the map with 16 bits and its elevations, both north up."""
    product = scene.map_product
    counts = np.clip(np.rint(_COUNTS * product.appearance[::-1]), 0, 65535).astype(np.uint16)
    cv2.imwrite(str(folder / "map.png"), counts)
    np.save(folder / "elevation.npy", product.elevation_m[::-1])


def ingest_map(folder: Path, target: Path) -> CasesFile:
    """Ingest a folder; return its cases."""
    target.mkdir()
    path, _ = ingest(folder, target)
    return CasesFile(file=str(path))
