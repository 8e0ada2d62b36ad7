"""Products of a synthetic landing over sinusoidal terrain with one rock, and rows of synthetic campaigns."""

from typing import Any

import numpy as np
import pandas as pd

#: Rows and columns of the elevation map.
SHAPE = (24, 32)
#: Cell size of the elevation map, height of the camera, and focal length for images of 320 x 240 pixels.
CELL_M, HEIGHT_M, FOCAL_PX = 0.25, 10.0, 240.0


def synthetic_products() -> dict[str, Any]:
    """Return products in the layout of `landing.products.case_products`, for a nadir camera with x axis to the east."""
    rng = np.random.default_rng(1)
    rows, columns = SHAPE
    corner = np.array([-0.5 * (columns - 1), 0.5 * (rows - 1)]) * CELL_M
    x = corner[0] + CELL_M * np.arange(columns)
    y = corner[1] - CELL_M * np.arange(rows)
    x, y = np.meshgrid(x, y)
    rock = 0.5 * np.exp(-((x - 2.0) ** 2 + (y - 1.0) ** 2) / 0.1)
    ground = 0.1 * np.sin(x) + rock
    slope = np.arctan(np.abs(0.1 * np.cos(x)))
    # 0: safe, 1: unknown, 2: hazard
    safety = np.where(np.hypot(x - 2.0, y - 1.0) < 2.0, 2, 0).astype(np.uint8)
    safety[:4] = 1
    pixels = np.stack([160.0 + FOCAL_PX * x / HEIGHT_M, 120.0 - FOCAL_PX * y / HEIGHT_M], axis=-1)
    features = rng.uniform(20.0, 220.0, (30, 2))
    grid = np.stack(np.meshgrid(np.arange(20.0, 300.0, 8.0), np.arange(20.0, 220.0, 8.0)), axis=-1).reshape(-1, 2)
    is_accepted = rng.random(30) < 0.8
    corner_rays = np.array([[-160, -120, 240], [160, -120, 240], [160, 120, 240], [-160, 120, 240]]) / FOCAL_PX
    camera = np.eye(4)
    camera[:3, 3] = (100.0, 50.0, HEIGHT_M)
    true_spacing_m = 0.1
    offset_x, offset_y = np.arange(-40, 41) * true_spacing_m, np.arange(-30, 31) * true_spacing_m
    true_x, true_y = np.meshgrid(100.0 + offset_x, 50.0 + offset_y)
    true_rock = 0.5 * np.exp(-((true_x - 102.0) ** 2 + (true_y - 51.0) ** 2) / 0.1)
    is_near_rock = np.hypot(true_x - 102.0, true_y - 51.0) < 1.2
    return {
        "image_1": rng.integers(0, 255, (240, 320)).astype(np.uint16),
        "image_2": rng.integers(0, 255, (240, 320)).astype(np.uint16),
        "features": features,
        "tracked": features + np.array([30.0, 0.0]),
        "tracks_accepted": is_accepted,
        "rotation": np.eye(3),
        "translation": np.array([-1.0, 0.0, 0.0]),
        "true_rotation": np.eye(3),
        "true_translation": np.array([-1.1, 0.0, 0.0]),
        "sparse_points": rng.uniform([-5.0, -4.0, 9.5], [5.0, 4.0, 10.0], (int(is_accepted.sum()), 3)),
        "frustum_0": corner_rays,
        "frustum_1": corner_rays,
        "grid": grid,
        "segment_starts": grid + np.array([24.0, 0.0]),
        "segment_ends": grid + np.array([36.0, 0.0]),
        "matched": grid + np.array([30.0, 0.0]),
        "matches_accepted": np.arange(len(grid)) % 7 > 0,
        "elevation": ground - HEIGHT_M,
        "roughness": rock,
        "slope": slope,
        "safety": safety,
        "map_pixels": pixels,
        "corner": corner,
        "cell": np.array([CELL_M]),
        "site": np.array([18.0, 5.0]),
        "apriori": np.array([11.5, 15.5]),
        "surface_from_camera": np.diag([1.0, -1.0, -1.0]),
        "world_from_surface": np.eye(3),
        # slope (rad), roughness (m) and footprint diameter (m)
        "limits": np.array([np.radians(15.0), 0.2, 2.0]),
        "camera_true": camera,
        "true_positions": np.stack([true_x, true_y], axis=-1),
        "true_heights": 0.1 * np.sin(true_x - 100.0) + true_rock,
        "true_corner": np.array([true_x[0, 0], true_y[0, 0]]),
        "true_spacing": np.array([true_spacing_m]),
        "true_slope": np.full(true_x.shape, 0.05),
        "true_roughness": np.where(is_near_rock, 0.5, 0.02),
        "true_safe": ~is_near_rock,
        "true_covered": np.hypot(true_x - 100.0, true_y - 50.0) < 3.0,
    }


def landing_frame(cases: int, seed: int = 1) -> pd.DataFrame:
    """Return rows of flights over rocks: 10 % report no safe site, 5 % have no result, 5 % of the sites are unsafe."""
    rng = np.random.default_rng(seed)
    outcome = rng.choice(["SAFE_SITE", "NO_SAFE_SITE", "NO_MOTION"], cases, p=[0.85, 0.1, 0.05])
    is_reported = outcome == "SAFE_SITE"
    is_safe = rng.random(cases) < 0.95
    error = np.where(is_reported, rng.rayleigh(0.8, cases), np.nan)
    frame = pd.DataFrame(
        {
            "case": np.arange(cases),
            "outcome": outcome,
            "answered": outcome != "NO_MOTION",
            "converged": outcome != "NO_MOTION",
            "site_reported": is_reported,
            "no_site_reported": outcome == "NO_SAFE_SITE",
            "site_safe": is_safe & is_reported,
            "descent_target_safe": is_safe & (outcome != "NO_SAFE_SITE"),
            "safe_site_exists": outcome != "NO_SAFE_SITE",
            "no_safe_site_exists": outcome == "NO_SAFE_SITE",
            "wide_site_exists": is_reported,
            "site_hazard_distance_m": np.where(is_reported, rng.uniform(0.2, 3.0, cases), np.nan),
            "true_safe_fraction": rng.random(cases),
            "landed": is_reported,
            "touchdown_safe": is_safe & is_reported,
            "touchdown_hazard_distance_m": np.where(is_reported, rng.uniform(0.1, 2.0, cases), np.nan),
            "touchdown_error_gps_m": error,
            "touchdown_error_m": 1.1 * error,
            "gps_sd_north_m": 0.5,
            "gps_sd_east_m": 0.4,
            "features": 70,
            "tracks": 60,
            "points": 600,
            "map_rows": 19,
            "map_columns": 27,
            "tracking_time_s": 0.006,
            "motion_time_s": 0.004,
            "structure_time_s": 0.006,
            "hazards_time_s": 0.001,
            "estimation_time_s": 0.018,
            "terrain": rng.integers(0, 8, cases),
            "footprints": 1000,
            "footprints_called_safe": 400,
            "footprints_called_safe_unsafe": 2,
            "footprints_truly_safe": 600,
            "false_alarms": 60,
            "missed": 8,
            "gross_hazards": 50,
            "gross_hazards_called_safe": 0,
            "gross_hazards_unflagged": 1,
            "fault": "none",
            "fault_size": 0.0,
        }
    )
    # classes of footprints by roughness or slope divided by its limit
    for kind in ("roughness", "slope"):
        for number, name in enumerate(("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")):
            frame[f"footprints_{kind}_{name}"] = 600 if number == 0 else 100
            frame[f"footprints_{kind}_{name}_safe"] = 400 if number == 0 else 4 - number
            frame[f"footprints_{kind}_{name}_unflagged"] = 540 if number == 0 else 8 - 2 * number
    return frame
