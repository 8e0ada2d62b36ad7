"""World, pictures and measurements of a landing case; landing site truth and errors of the hazard map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16
from scipy.ndimage import distance_transform_edt

from marsyard.algorithms.hda import Ground, Safety
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.conditions import deliver, faulty_detector
from marsyard.scenarios.exposure import Optics, camera_optics, draw_calibrated, render_state, sunlight_ratio
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import Flight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters, faulty_ranges, faulty_sun_deg
from marsyard.scenarios.landing.relief import SPACING_DIAMETERS, Footprints, Limits, Relief
from marsyard.scenarios.meshes import MeshParameters, add_meshes
from marsyard.scenarios.views import Eye, SiteGround, site_scene
from marsyard.sim.frames import direction
from marsyard.sim.measurements import DetectorImage, LandingMeasurements
from marsyard.sim.render import Frame, Sun
from marsyard.sim.sensor import Detector, auto_expose
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import site
from marsyard.sim.terrain.sites import SiteTexture

#: Grounds that a worker keeps: their rocks take a second or two to place.
KEPT_GROUNDS = 64


@dataclass(frozen=True)
class World:
    """Terrain with rocks, custom meshes and sun of a landing."""

    ground: SiteGround
    sun: Sun
    meshes: tuple[MeshParameters, ...]
    brightness: float  #: sunlight at the ground relative to that of the detector's stated responsivity

    @classmethod
    def of(cls, p: LandingScenarioParameters, load_ground: LoadGround = SiteGround.from_bank) -> World:
        """The world of a case."""
        ground = load_ground(site(p.site), p.terrain, p.location.bank_seed, p.location.terrain)
        texture = p.preset.ground_texture
        textured = SiteTexture(
            coarsest_m=texture.coarsest_m, amplitudes=tuple(p.texture * one for one in texture.amplitudes)
        )
        ground = replace(ground, site=p.preset.model_copy(update={"ground_texture": textured}))
        air = p.preset.environment
        elevation = float(np.radians(faulty_sun_deg(p.faults, p.sun.elevation_deg)))
        sun = Sun(direction(np.radians(p.sun.azimuth_deg), elevation), air.sun_radius_rad)
        return cls(ground, sun, p.meshes, sunlight_ratio(air, elevation, p.detector))


@dataclass(frozen=True)
class Pair:
    """Two pictures of a flight."""

    images: tuple[DetectorImage, DetectorImage]  #: as delivered, with the true camera
    frames: tuple[Frame, Frame]  #: rendered radiance and truth

    @property
    def counts(self) -> tuple[UInt16[np.ndarray, "rows columns"], UInt16[np.ndarray, "rows columns"]]:
        """The pictures' counts."""
        return self.images[0].counts, self.images[1].counts

    @property
    def axis_range_m(self) -> float:
        """True range along the first picture's optical axis to ground or rock, metres."""
        frame = self.frames[0]
        column, row = self.images[0].camera.project(np.array([self.images[0].camera.a]))[0][0]
        # the four pixels about the axis, at most 0.7 px away
        near = frame.range_m[int(row) : int(row) + 2, int(column) : int(column) + 2]
        return float(np.median(near))


def take_pictures(p: LandingScenarioParameters, world: World, flight: Flight, optics: Optics, streams: Streams) -> Pair:
    """The pictures of a flight; both have the exposure that suits the first."""
    detector = Detector.draw(
        optics.fall_off, faulty_detector(p.faults, p.detector), streams.generator("detector response")
    )
    caster = max(p.lander.caster_diameter_m, p.faults.vehicle_shadow_m)
    lower = min(flight.states, key=lambda state: float(state.position_m[2]))
    # one scene for both pictures, as detailed as the lower one needs
    eye = Eye.of(optics.rays, lower.world_from_body, world.ground.surface)
    scene = add_meshes(site_scene(world.ground, eye, world.sun), world.meshes, (eye.east_m, eye.north_m))
    scene = replace(scene, caster_diameter_m=caster)
    noise = streams.generator("detector noise")
    rendered = [render_state(p.render.backend, scene, optics, state) for state in flight.states]
    frames, motions = zip(*rendered, strict=True)
    light = [frame.radiance * np.float32(world.brightness) for frame in frames]
    detector = auto_expose(detector, light[0], p.exposure, streams.generator("test pictures")).detector
    counts = [detector.expose(one, noise, motion) for one, motion in zip(light, motions, strict=True)]
    delivered = deliver(counts, 2 * p.faults.repeated_picture, p.faults.black_picture, p.faults.lost_rows)
    camera = optics.camera.bin(columns=1, rows=p.detector.rows_summed)
    first, second = (
        DetectorImage(one, state.time_s, camera, detector.calibration)
        for one, state in zip(delivered, flight.states, strict=True)
    )
    return Pair((first, second), (frames[0], frames[1]))


def measure(p: LandingScenarioParameters, flight: Flight, pair: Pair, streams: Streams) -> LandingMeasurements:
    """The measurements of a case.

    The a-priori site is the ground on the first picture's optical axis, at the measured range; without one, at the
    commanded height.
    """
    unit = RangingUnit.draw(p.laser, streams.generator("laser"))
    reading = unit.readings(np.zeros(1), np.array([pair.axis_range_m]), streams.generator("laser noise"))
    slant = float(faulty_ranges(p.faults, reading.values, p.height_m)[0])
    calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
    camera = calibrated.bin(columns=1, rows=p.detector.rows_summed)
    first, second = (replace(image, camera=camera) for image in pair.images)
    ahead = (slant if np.isfinite(slant) else p.height_m) * camera.a
    return LandingMeasurements(
        images=(first, second),
        poses=flight.poses,
        slant_range_m=slant,
        up_body=flight.up_body,
        apriori_site_world=np.asarray(flight.poses[0].world_from_body.apply(ahead)),
    )


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
        points_seen = pair.frames[0].points_world()[::8, ::8, :2].reshape(-1, 2)
        hull = cv2.convexHull(points_seen[np.all(np.isfinite(points_seen), axis=1)].astype(np.float32))
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
        heights = relief.average(places, relief.spacing_m)
        # points of the ground in both pictures
        points, visible = np.concatenate([corners, heights.reshape(-1, 1)], axis=1), np.ones(len(corners), dtype=bool)
        for image, state in zip(pair.images, flight.states, strict=True):
            pixels, ahead = image.camera.transform(state.world_from_body).project(points)
            with np.errstate(invalid="ignore"):
                visible &= ahead & np.all((pixels >= 0.0) & (pixels <= np.array(image.camera.size) - 1.0), axis=1)
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
        site_class = np.where(self.footprints.safe[at], SAFE, UNSAFE)
        hazard[inside] = np.where(self.covered[at], site_class, UNKNOWN)
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


#: Bounds of the hazard classes over the limit, and names of the classes between them.
CLASSES = (1.0, 1.5, 2.0, 3.0)
CLASS_NAMES = ("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")
#: Gross hazards (bar 2 of the validation): minimum diameter in cells, and minimum roughness over the limit.
GROSS_CELLS, GROSS = 3.0, 2.0


@dataclass(frozen=True)
class SampledMap:
    """The algorithm's map at the truth's positions."""

    #: whether the map has slope and roughness there, and both pictures show the footprint
    known: Bool[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]  #: whether the map calls the position safe
    flagged: Bool[np.ndarray, "rows columns"]  #: whether a hazard cell, before growth, lies under the lander
    slope_rad: Float[np.ndarray, "rows columns"]

    @classmethod
    def of(cls, ground: Ground, flight: Flight, truth: GroundTruth, limits_rad_m: tuple[float, float]) -> SampledMap:
        """The map at the truth's positions; `limits_rad_m`: the algorithm's own limits of slope and roughness."""
        away = truth.places - flight.states[0].position_m[:2]
        local = np.asarray(away @ ground.world_from_surface.as_matrix()[:2, :2])
        cells = np.rint(ground.elevation.cells(local)).astype(np.int64)
        shape = np.array(ground.elevation.elevation_m.shape)
        inside = np.all((cells >= 0) & (cells < shape), axis=-1) & truth.covered
        rows, columns = np.moveaxis(np.clip(cells, 0, shape - 1), -1, 0)
        hazards = ground.hazards
        with np.errstate(invalid="ignore"):
            raw = (hazards.slope_rad > limits_rad_m[0]) | (hazards.roughness_m > limits_rad_m[1])
        reach = 0.5 * truth.limits.diameter_m / ground.elevation.cell_m
        near = distance_transform_edt(~raw) <= reach if np.any(raw) else np.zeros_like(raw)
        slope = hazards.slope_rad[rows, columns]
        finite = inside & np.isfinite(slope) & np.isfinite(hazards.roughness_m[rows, columns])
        safe = finite & (hazards.safety[rows, columns] == Safety.SAFE)
        return cls(finite, safe, finite & near[rows, columns], slope)


def hazard_counts(ground: Ground, at: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Confusion counts of footprints, truth against map; sums over cases give rates.

    For each class of roughness and of slope over the limit: `footprints_*` in all, `footprints_*_safe` that the map
    calls safe, `footprints_*_unflagged` without a map hazard before growth. `gross_*` are hazards of twice the limit of
    roughness with a diameter of at least three cells; `false_alarms` are truly safe footprints with a map hazard.
    """
    under, known, safe = truth.footprints, at.known, at.safe
    over = {
        "roughness": under.roughness_m / truth.limits.max_roughness_m,
        "slope": under.slope_rad / truth.limits.max_slope_rad,
    }
    diameter_cells = 2.0 * np.sqrt(under.exceeding_m2 / np.pi) / ground.elevation.cell_m
    gross = (under.roughness_m >= GROSS * truth.limits.max_roughness_m) & (diameter_cells >= GROSS_CELLS)
    counted = {
        "footprints": known,
        "footprints_called_safe": safe,
        "footprints_called_safe_unsafe": safe & ~under.safe,
        "footprints_truly_safe": known & under.safe,
        "false_alarms": known & under.safe & at.flagged,
        "missed": known & ~under.safe & ~at.flagged,
        "gross_hazards": known & gross,
        "gross_hazards_called_safe": safe & gross,
        "gross_hazards_unflagged": known & gross & ~at.flagged,
    }
    for kind, ratio in over.items():
        classes = np.digitize(ratio, CLASSES)
        for number, name in enumerate(CLASS_NAMES):
            members = known & (classes == number)
            column = f"footprints_{kind}_{name}"
            counted |= {column: members, f"{column}_safe": members & safe, f"{column}_unflagged": members & ~at.flagged}
    return {column: int(np.count_nonzero(chosen)) for column, chosen in counted.items()}


def map_errors(ground: Ground, flight: Flight, at: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Errors of the map's elevation and slope.

    The elevation is compared with the mean of the exact heights over each cell, relative to the camera. `bias` is the
    mean error, `rms` its RMS about zero, `noise` the robust standard deviation about the error's plane, which affects
    roughness; `outliers` is the fraction beyond five of these.
    """
    rows, columns = np.indices(ground.elevation.elevation_m.shape)
    local = ground.elevation.places(np.stack([rows, columns], axis=-1).astype(np.float64))
    start = flight.states[0].position_m
    places = start[:2] + local @ ground.world_from_surface.as_matrix()[:2, :2].T
    exact = truth.relief.average(places, ground.elevation.cell_m) - start[2]
    error = ground.elevation.elevation_m - exact
    finite = np.isfinite(error)
    values = error[finite]
    if values.size < 4:
        return {}
    design = np.column_stack([local[finite], np.ones(values.size)])
    near = np.abs(values - np.median(values)) <= 5.0 * _deviation(values)
    level = values - design @ np.linalg.lstsq(design[near], values[near], rcond=None)[0]
    noise = _deviation(level)
    slope_errors = (at.slope_rad - truth.footprints.slope_rad)[at.known]
    some = slope_errors.size > 0
    return {
        "elevation_bias_m": float(values.mean()),
        "elevation_rms_m": float(np.sqrt(np.mean(values**2))),
        "elevation_median_error_m": float(np.median(np.abs(values))),
        "elevation_noise_m": noise,
        "elevation_outliers": float(np.mean(np.abs(level) > 5.0 * noise)),
        "slope_error_bias_deg": float(np.degrees(slope_errors.mean())) if some else float("nan"),
        "slope_error_rms_deg": float(np.degrees(np.sqrt(np.mean(slope_errors**2)))) if some else float("nan"),
    }


def _deviation(values: Float[np.ndarray, "n"]) -> float:
    """Robust standard deviation, at least 1e-12: positive also where more than half of the values are equal."""
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)
