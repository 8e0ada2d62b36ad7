"""What the products of a landing's case hold, read with care: they come from files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from marsyard.reports.presentation import numbers, plane, shaped


@dataclass(frozen=True)
class TrackedFeatures:
    """Features and their tracks, pixels (u, v)."""

    first: Float[np.ndarray, "n 2"]
    second: Float[np.ndarray, "n 2"]
    accepted: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class SolvedMotion:
    """Motion and structure in the first camera's frame, metres.

    Attributes
    ----------
    rotation, translation
        Of the second from the first camera.
    points
        The accepted tracks' places, shape (n, 3).
    corner_rays
        Rays of the two pictures' corners in their cameras' frames, of depth one.
    true_rotation, true_translation
        The true motion.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    points: Float[np.ndarray, "n 3"]
    corner_rays: tuple[Float[np.ndarray, "4 3"], Float[np.ndarray, "4 3"]]
    true_rotation: Float[np.ndarray, "3 3"]
    true_translation: Float[np.ndarray, "3"]


@dataclass(frozen=True)
class EpipolarMatches:
    """Structure pixels, their segments in the second picture, and what was matched; pixels (u, v)."""

    grid: Float[np.ndarray, "n 2"]
    starts: Float[np.ndarray, "n 2"]
    ends: Float[np.ndarray, "n 2"]
    matched: Float[np.ndarray, "n 2"]
    accepted: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class LandingMaps:
    """The maps of a case; all have the elevation map's cells, row 0 farthest along y.

    Attributes
    ----------
    elevation_m, roughness_m, slope_rad
        As mapped, the elevation from the first camera.
    safety
        0 safe, 1 unknown, 2 hazard.
    pixels
        Of the first picture, for every cell's middle; where its elevation is not known, about there.
    corner_m, cell_m
        (x, y) of the first cell's middle in the surface frame, and the cells' side.
    site, apriori
        Row and column; NaN for no site.
    surface_from_camera, world_from_surface
        Rotations.
    limits
        Of slope (radians) and roughness (metres), and the lander's diameter.
    """

    elevation_m: Float[np.ndarray, "rows columns"]
    roughness_m: Float[np.ndarray, "rows columns"]
    slope_rad: Float[np.ndarray, "rows columns"]
    safety: Float[np.ndarray, "rows columns"]
    pixels: Float[np.ndarray, "rows columns 2"]
    corner_m: Float[np.ndarray, "2"]
    cell_m: float
    site: Float[np.ndarray, "2"]
    apriori: Float[np.ndarray, "2"]
    surface_from_camera: Float[np.ndarray, "3 3"]
    world_from_surface: Float[np.ndarray, "3 3"]
    limits: Float[np.ndarray, "3"]

    def cells(self, away_m: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 2"]:
        """(row, column), not whole, of places (x, y) along the world's axes from the camera's foot."""
        local = away_m @ self.world_from_surface[:2, :2]
        return np.asarray(((local - self.corner_m) / self.cell_m * np.array([1.0, -1.0]))[..., ::-1])


@dataclass(frozen=True)
class TrueGround:
    """The truth on its lattice.

    Attributes
    ----------
    away_m
        World x, y of the places from the camera's true foot.
    elevation_m
        Exact height at the places from the camera.
    slope_rad, roughness_m, safe
        Of a lander's footprint there.
    covered
        Whether both pictures show all of it.
    """

    away_m: Float[np.ndarray, "rows columns 2"]
    elevation_m: Float[np.ndarray, "rows columns"]
    slope_rad: Float[np.ndarray, "rows columns"]
    roughness_m: Float[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]
    covered: Bool[np.ndarray, "rows columns"]


def is_hda_case(products: Mapping[str, Any]) -> bool:
    """Whether products hold two pictures and the truth of a landing."""
    return pictures(products) is not None and true_ground(products) is not None


def pictures(products: Mapping[str, Any]) -> tuple[Float[np.ndarray, "_ _"], Float[np.ndarray, "_ _"]] | None:
    """The two pictures; None where one is missing."""
    first, second = (plane(products.get(f"image_{number}")) for number in (1, 2))
    return None if first is None or second is None else (first, second)


def tracked_features(products: Mapping[str, Any]) -> TrackedFeatures | None:
    """Features and tracks; None where there are none."""
    first, second = (shaped(products.get(name), None, 2) for name in ("features", "tracked"))
    accepted = _flags(products, "tracks_accepted")
    if first is None or second is None or accepted is None or not len(first) == len(second) == len(accepted):
        return None
    return TrackedFeatures(first, second, accepted)


def solved_motion(products: Mapping[str, Any]) -> SolvedMotion | None:
    """Motion and structure; None where none was found."""
    rotations = [_finite(products, name, 3, 3) for name in ("rotation", "true_rotation")]
    translations = [_finite(products, name, 3) for name in ("translation", "true_translation")]
    rays = [_finite(products, f"frustum_{number}", 4, 3) for number in (0, 1)]
    points = shaped(products.get("sparse_points"), None, 3)
    known = [one for one in (*rotations, *translations, *rays) if one is not None]
    if points is None or not len(points) or len(known) < 6:
        return None
    return SolvedMotion(known[0], known[2], points, (known[4], known[5]), known[1], known[3])


def epipolar_matches(products: Mapping[str, Any]) -> EpipolarMatches | None:
    """Structure pixels and matches; None where there are none."""
    arrays = [shaped(products.get(name), None, 2) for name in ("grid", "segment_starts", "segment_ends", "matched")]
    known = [one for one in arrays if one is not None]
    accepted = _flags(products, "matches_accepted")
    if len(known) < 4 or accepted is None or {len(one) for one in known} != {len(accepted)}:
        return None
    return EpipolarMatches(known[0], known[1], known[2], known[3], accepted)


def landing_maps(products: Mapping[str, Any]) -> LandingMaps | None:
    """The maps; None where the ground was not mapped."""
    planes = [numbers(products.get(name)) for name in ("elevation", "roughness", "slope", "safety")]
    known = [one for one in planes if one is not None and one.ndim == 2 and min(one.shape) >= 2]
    if len(known) < 4 or len({one.shape for one in known}) > 1:
        return None
    shapes = {
        "corner": (2,),
        "apriori": (2,),
        "surface_from_camera": (3, 3),
        "world_from_surface": (3, 3),
        "limits": (3,),
    }
    others = [_finite(products, name, *shape) for name, shape in shapes.items()]
    further = [one for one in others if one is not None]
    pixels = numbers(products.get("map_pixels"))
    if pixels is None or pixels.shape != (*known[0].shape, 2):
        return None
    cell = numbers(products.get("cell"))
    if len(further) < len(shapes) or cell is None or cell.size != 1 or not cell.item() > 0.0:
        return None
    corner, apriori, surface, world, limits = further
    if not np.all(limits > 0.0):
        return None
    site = _finite(products, "site", 2)
    return LandingMaps(
        elevation_m=known[0],
        roughness_m=known[1],
        slope_rad=known[2],
        safety=known[3],
        pixels=_filled(pixels),
        corner_m=corner,
        cell_m=float(cell.item()),
        site=np.full(2, np.nan) if site is None else site,
        apriori=apriori,
        surface_from_camera=surface,
        world_from_surface=world,
        limits=limits,
    )


def _filled(pixels: Float[np.ndarray, "rows columns 2"]) -> Float[np.ndarray, "rows columns 2"]:
    """Pixels of all cells: where they are not known those of an affine map of the others, as of level ground."""
    known = np.isfinite(pixels).all(axis=-1)
    if known.all() or known.sum() < 3:
        return pixels
    cells = np.concatenate([np.moveaxis(np.indices(known.shape), 0, -1), np.ones((*known.shape, 1))], axis=-1)
    level = np.linalg.lstsq(cells[known], pixels[known], rcond=None)[0]
    return np.where(known[..., None], pixels, cells @ level)


def true_ground(products: Mapping[str, Any]) -> TrueGround | None:
    """The truth; None where it is missing."""
    places, camera = numbers(products.get("true_places")), _finite(products, "camera_true", 4, 4)
    heights, corner = numbers(products.get("true_heights")), _finite(products, "true_corner", 2)
    spacing = numbers(products.get("true_spacing"))
    if places is None or places.ndim != 3 or places.shape[2] != 2 or min(places.shape[:2]) < 2:
        return None
    if camera is None or heights is None or heights.ndim != 2 or not heights.size or corner is None:
        return None
    shape = places.shape[:2]
    planes = [_finite(products, f"true_{name}", *shape) for name in ("slope", "roughness", "safe", "covered")]
    known = [one for one in planes if one is not None]
    if len(known) < 4 or spacing is None or spacing.size != 1 or not spacing.item() > 0.0:
        return None
    at = np.nan_to_num((places - corner)[..., ::-1] / spacing.item())
    rows, columns = np.moveaxis(np.clip(np.rint(at), 0, np.array(heights.shape) - 1).astype(np.int64), -1, 0)
    return TrueGround(
        away_m=places - camera[:2, 3],
        elevation_m=heights[rows, columns] - camera[2, 3],
        slope_rad=known[0],
        roughness_m=known[1],
        safe=known[2] > 0.5,
        covered=known[3] > 0.5,
    )


def _flags(products: Mapping[str, Any], name: str) -> Bool[np.ndarray, " n"] | None:
    values = shaped(products.get(name), None)
    return None if values is None else values > 0.5


def _finite(products: Mapping[str, Any], name: str, *shape: int) -> Float[np.ndarray, "..."] | None:
    values = shaped(products.get(name), *shape)
    return values if values is not None and np.isfinite(values).all() else None
