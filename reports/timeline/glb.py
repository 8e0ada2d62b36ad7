"""Scene of a case as a binary glTF file (.glb), for Blender, web browsers and other viewers."""

from pathlib import Path

import numpy as np
import trimesh

from marsyard.reports.timeline.mesh import camera_outlines, colour, ground_width_m, triangulate, vertex_colours
from marsyard.scenarios.timeline import Timeline

#: Rotation from the world (z up) to glTF (y up).
_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def write_glb(path: Path, timeline: Timeline) -> None:
    """Write surfaces, paths, cameras and points. Raises OSError on failure.

    The origin is the centre of the ground, because glTF stores single precision; its world coordinates are in the
    scene's extras (`origin_m`). Axes: x east, y up, z south.
    """
    ground = timeline.surfaces["ground"].points_m.reshape(-1, 3)
    origin_m = np.round(np.nanmean(ground, axis=0)).astype(np.float64)
    scene = trimesh.Scene(metadata={"origin_m": origin_m.tolist()})
    for name, patch in timeline.surfaces.items():
        vertices = np.nan_to_num(patch.points_m.reshape(-1, 3).astype(np.float64) - origin_m)
        mesh = trimesh.Trimesh(vertices, triangulate(patch), vertex_colors=vertex_colours(patch), process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    for name, track in timeline.paths.items():
        if len(track.positions_m) > 1:
            _add_lines(scene, f"path {name}", track.positions_m - origin_m, colour(name))
    width_m = ground_width_m(timeline)
    for number, image in enumerate(timeline.images, start=1):
        edges = camera_outlines(image, width_m) - origin_m
        _add_lines(scene, f"{image.camera}, image {number}", edges, colour(image.camera))
    for name, points in timeline.points.items():
        if len(points.positions_m):
            colours = np.tile([*colour(name), 255], (len(points.positions_m), 1)).astype(np.uint8)
            scene.add_geometry(trimesh.PointCloud(points.positions_m - origin_m, colours), node_name=f"points {name}")
    scene.apply_transform(_Y_UP)
    path.write_bytes(scene.export(file_type="glb"))


def _add_lines(scene: trimesh.Scene, name: str, lines: np.ndarray, rgb: tuple[int, int, int]) -> None:
    """Add a polyline (n, 3), or line segments (n, 2, 3), of one colour to a scene."""
    path = trimesh.load_path(lines)
    path.colors = np.tile([*rgb, 255], (len(path.entities), 1)).astype(np.uint8)
    scene.add_geometry(path, node_name=name, geom_name=name)
