"""Files of a rendered image: 16-bit image, truth layers, camera model and metadata."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from marsyard.sim import sensor
from marsyard.sim.camera import BODY_FRAME, write_cahvor
from marsyard.sim.render import process_renderer
from marsyard.sim.render.backend import default_backend
from marsyard.site_images import FULL_SCALE_RADIANCE_FACTOR, ImageRequest, RenderedImage

#: Files of an image: 16-bit image, truth layers, camera model, and metadata.
SUFFIXES = (".png", ".npz", ".cahvor", ".json")


def truth_layers(image: RenderedImage) -> dict[str, Any]:
    """Compute the ground-truth layers, each with the rows and columns of the image, and the pose.

    The shadow is found by rendering the image again, in the light of the sun's disc only.
    """
    frame, scene = image.frame, image.scene
    directions = frame.world_from_body.rotation.apply(frame.rays.directions.astype(np.float64))
    phase = np.degrees(np.arccos(np.clip(-(directions @ scene.sun.direction), -1.0, 1.0)))
    is_ground = np.isfinite(frame.range_m)
    # without diffuse light and aureole, pixels with zero radiance are in shadow
    direct_light = replace(scene.photometry, sky_fraction=0.0, sky_radiance=0.0, surrounding_albedo=0.0, sky=None)
    direct_frame = process_renderer(default_backend()).render(
        scene.with_photometry(direct_light).with_edge_rays(1), frame.rays, frame.world_from_body
    )
    # the body indices -2 (sky) and -1 (ground) select the last two names
    names = np.append(scene.objects.names, [-2, -1])
    return {
        "radiance_factor": frame.radiance,
        "range_m": frame.range_m,
        "point_m": frame.points_world(),
        "normal": frame.normal,
        "object": names[frame.body].astype(np.int32),
        "shadow": is_ground & (direct_frame.radiance <= 0.0),
        "phase_deg": np.where(is_ground, phase.reshape(is_ground.shape), np.nan).astype(np.float32),
        "world_from_body": frame.world_from_body.as_matrix(),
        **({} if image.filled is None else {"filled": image.filled}),
    }


def write_image(image: RenderedImage, request: ImageRequest, prefix: Path) -> list[Path]:
    """Write the files of an image (see `SUFFIXES`); return their paths."""
    png, npz, cahvor, metadata = (_build_path(prefix, image.suffix, ending) for ending in SUFFIXES)
    png.write_bytes(encode_image(".png", image.to_uint16()))
    with npz.open("wb") as file:
        np.savez(file, **truth_layers(image))
    write_cahvor(image.camera_body, cahvor, f"{request.camera}{image.suffix} at {request.site}", frame=BODY_FRAME)
    metadata.write_text(json.dumps(describe_image(image, request), indent=2) + "\n", encoding="utf-8")
    return [png, npz, cahvor, metadata]


def describe_image(image: RenderedImage, request: ImageRequest) -> dict[str, Any]:
    """Return the metadata of an image: all inputs, and a description of the quantities in its files."""
    columns, rows = image.camera_world.size
    scene, auto_exposure, detector = image.scene, image.auto_exposure, None
    png: dict[str, Any] = {
        "holds": "radiance factor (I/F) relative to the solar irradiance at the ground",
        "full_scale_radiance_factor": FULL_SCALE_RADIANCE_FACTOR,
    }
    if auto_exposure is not None:
        detector = auto_exposure.detector.parameters
        png = {
            "holds": "detector counts, in the upper bits",
            "multiplied_by": image.count_scale,
            "exposure_s": detector.exposure_s,
            "auto_exposure_converged": auto_exposure.converged,
        }
    return {
        "marsyard": version("marsyard"),
        "shot": asdict(request),
        "image": image.suffix.lstrip("-") or "single",
        "size": {"columns": columns, "rows": rows},
        "png": png,
        "npz": {
            "object": "number of the visible rock; -1 ground, -2 sky",
            "shadow": "no light from the sun's disc: a cast shadow, or a surface that faces away from the sun",
            "frame": "world: x east, y north (grid north for a DTM), z up, metres",
            "filled": "the pixel sees a filled hole of the DTM",
        },
        "cahvor": {"frame": "body frame; world_from_body transforms it to the world frame"},
        "filled_fraction": None if image.filled is None else float(image.filled.mean()),
        "world_from_body": image.frame.world_from_body.as_matrix().tolist(),
        "sun_direction": scene.sun.direction.tolist(),
        "photometry": asdict(scene.photometry),
        "mesh": {name: getattr(scene, name) for name in ("mesh_finest_m", "mesh_half_width_m", "mesh_lines")},
        "rocks_drawn": len(scene.objects),
        "site": request.site_definition.model_dump(mode="json"),
        "detector": None if detector is None else detector.model_dump(mode="json"),
        "gl_backend": default_backend(),
    }


def _build_path(prefix: Path, suffix: str, ending: str) -> Path:
    return prefix.with_name(f"{prefix.name}{suffix}{ending}")


def check_files(prefix: Path, camera: str, overwrite: bool) -> None:
    """Raise ValueError if the files cannot be written, or exist and `overwrite` is False."""
    folder = prefix.parent
    if prefix.name in ("", ".", ".."):
        raise ValueError(f"--out {prefix} is not a file name; give a path without extension, such as images/gusev")
    if not folder.is_dir():
        raise ValueError(f"--out {prefix}: the folder {folder} does not exist")
    if not os.access(folder, os.W_OK):
        raise ValueError(f"--out {prefix}: the folder {folder} is not writable")
    suffixes = ("",) if sensor.preset(camera).design.baseline_m is None else ("-left", "-right")
    paths = [_build_path(prefix, suffix, ending) for suffix in suffixes for ending in SUFFIXES]
    existing = [str(path) for path in paths if path.exists()]
    if existing and not overwrite:
        raise ValueError(f"{', '.join(existing)}: files exist; use --overwrite to replace them")


def encode_image(extension: str, image: np.ndarray, options: Sequence[int] = ()) -> bytes:
    """Encode an image in the format of a file extension, with options of OpenCV. Raises ValueError on failure."""
    is_encoded, buffer = cv2.imencode(extension, image, options)
    if not is_encoded:
        raise ValueError(f"an image could not be encoded as {extension}")
    return buffer.tobytes()
