"""Landing site truth of a flight: footprint hazards on a lattice over the ground in both pictures."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import distance_transform_edt

from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters
from marsyard.scenarios.landing.pictures import Pair, World, take_pictures, visible_in_both
from marsyard.scenarios.landing.relief import SPACING_DIAMETERS, Footprints, Limits, Relief
from marsyard.scenarios.optics import camera_optics
from marsyard.scenarios.views import SiteGround
from marsyard.sim.streams import Streams

#: Spacing of the lattice, in diameters of the footprint: 20 cm for 2 m.
STEP_DIAMETERS = 0.1
#: Margin of the relief beyond the ground in sight, in diameters: for footprints and landings next to it.
MARGIN_DIAMETERS = 1.5
#: Values of a hazard map: the footprint about the pixel's point is safe, unsafe, or partly out of sight.
SAFE, UNSAFE, UNKNOWN = 0, 1, 255


@dataclass(frozen=True)
class GroundTruth:
    """The true ground of a flight on a lattice about the first picture, along its horizontal axes."""

    relief: Relief
    limits: Limits
    places: Float[np.ndarray, "rows columns 2"]  #: world x, y of the lattice
    footprints: Footprints  #: the ground under a lander at each position
    covered: Bool[np.ndarray, "rows columns"]  #: whether both pictures show the whole footprint
    step_m: float

    @classmethod
    def of(cls, world: World, flight: Flight, pair: Pair, limits: Limits) -> GroundTruth:
        """The truth over the ground of the first picture."""
        centre = flight.states[0].position_m
        # the picture's right and up, as unit vectors on the ground (rows)
        right = flight.states[0].attitude.apply(np.array([1.0, 0.0, 0.0]))[:2]
        right = right / np.hypot(*right)
        axes = np.array([right, [-right[1], right[0]]])
        points = pair.frames[0].points_world()[::8, ::8, :2].reshape(-1, 2)
        hull = cv2.convexHull(points[np.all(np.isfinite(points), axis=1)].astype(np.float32))
        outline = (hull[:, 0].astype(np.float64) - centre[:2]) @ axes.T
        step = STEP_DIAMETERS * limits.diameter_m
        low, high = (np.floor(end / step) * step for end in (outline.min(axis=0), outline.max(axis=0)))
        x, y = (np.arange(a, b + 0.5 * step, step) for a, b in zip(low, high, strict=True))
        local = np.stack(np.meshgrid(x, y), axis=-1)
        places = np.asarray(centre[:2] + local @ axes)
        margin = MARGIN_DIAMETERS * limits.diameter_m
        corners = places.reshape(-1, 2)
        west_south, east_north = corners.min(axis=0) - margin, corners.max(axis=0) + margin
        relief = Relief.of(world.ground, west_south, east_north, SPACING_DIAMETERS * limits.diameter_m, world.meshes)
        heights = relief.averaged(places, relief.spacing_m)
        visible = visible_in_both(pair, flight, np.concatenate([corners, heights.reshape(-1, 1)], axis=1), 0.0)
        around = distance_transform_edt(np.pad(visible.reshape(heights.shape), 1))[1:-1, 1:-1] * step
        covered = around >= 0.5 * limits.diameter_m
        return cls(relief, limits, places, relief.footprints(places, limits), covered, step)

    @property
    def safe(self) -> Bool[np.ndarray, "rows columns"]:
        """Safe positions whose footprint both pictures show."""
        return np.asarray(self.covered & self.footprints.safe)

    @property
    def safe_with_margin(self) -> Bool[np.ndarray, "rows columns"]:
        """Safe positions with safe positions all around up to the footprint's radius, as margin for errors."""
        distance_m = distance_transform_edt(np.pad(self.safe, 1))[1:-1, 1:-1] * self.step_m
        return np.asarray(distance_m > 0.5 * self.limits.diameter_m)

    def distance_to_hazard_m(self, place: Float[np.ndarray, "2"]) -> float:
        """Distance of a position (x, y) from the nearest unsafe position of the lattice."""
        unsafe = self.places[~self.footprints.safe]
        return float(np.hypot(*(unsafe - place).T).min()) if len(unsafe) else float("inf")

    def hazard_map(self, points: Float[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns"]:
        """Hazard class of the footprint about each pixel's point, at the nearest position of the lattice."""
        origin = self.places[0, 0]
        axes = np.stack([self.places[0, 1] - origin, self.places[1, 0] - origin], axis=1)
        cells = np.linalg.solve(axes, (points[..., :2] - origin).reshape(-1, 2).T).T
        inside = np.asarray(np.isfinite(cells).all(axis=1))
        columns, rows = np.rint(np.where(inside[:, None], cells, -1.0)).astype(np.int64).T
        shape = self.covered.shape
        inside &= (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
        hazard = np.full(len(cells), UNKNOWN, dtype=np.uint8)
        at = rows[inside], columns[inside]
        known = np.where(self.footprints.safe[at], SAFE, UNSAFE)
        hazard[inside] = np.where(self.covered[at], known, UNKNOWN)
        return hazard.reshape(points.shape[:2])

    def under(self, place: Float[np.ndarray, "2"]) -> Footprints | None:
        """The ground under a lander at any position (x, y); None outside the relief."""
        try:
            return self.relief.footprints(place[None], self.limits)
        except ValueError:
            return None


@dataclass(frozen=True)
class RenderedFlight:
    """A flight with its world, pictures and ground truth."""

    p: LandingScenarioParameters
    world: World
    flight: Flight
    pair: Pair
    truth: GroundTruth

    @classmethod
    def of(
        cls, p: LandingScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank
    ) -> RenderedFlight:
        """Fly a case and take its pictures."""
        world = World.of(p, load_ground)
        flight = Flight.of(p, world.ground.surface, streams)
        pair = take_pictures(p, world, flight, camera_optics(p.optics), streams)
        return cls(p, world, flight, pair, GroundTruth.of(world, flight, pair, p.lander.limits))
