"""Simulate images and measurements of a landing case; compute ground truth of sites and errors of the hazard map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8, UInt16
from scipy.ndimage import distance_transform_edt

from marsyard.algorithms.hda import MappedGround, Safety
from marsyard.scenarios.base import LoadGround
from marsyard.scenarios.cameras import Optics, camera_optics, draw_calibrated
from marsyard.scenarios.case_faults import add_detector_faults, corrupt_images
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.parameters import LandingScenarioParameters, add_range_faults, raise_sun_deg
from marsyard.scenarios.landing.relief import SPACING_DIAMETERS, Footprints, Limits, Relief
from marsyard.scenarios.meshes import MeshParameters, add_meshes
from marsyard.scenarios.radiance import render_state, sun_at, sunlight_ratio
from marsyard.scenarios.views import SiteGround, Viewpoint, site_scene
from marsyard.sim.measurements import DetectorImage, LandingMeasurements
from marsyard.sim.render import Frame, Sun
from marsyard.sim.sensor import Detector, auto_expose
from marsyard.sim.sensor.ranging import RangingUnit
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import site
from marsyard.sim.terrain.sites import SiteTexture

#: Maximum number of terrains in a worker's memory: those of several campaigns, or of a small bank; 12 MB each.
MAX_GROUNDS = 4


@dataclass(frozen=True)
class LandingWorld:
    """Terrain with rocks, custom meshes, and sun of a landing case."""

    ground: SiteGround
    sun: Sun
    meshes: tuple[MeshParameters, ...]
    brightness: float  #: sunlight at the ground / reference sunlight of the detector

    @classmethod
    def from_parameters(
        cls, p: LandingScenarioParameters, load_ground: LoadGround = SiteGround.from_bank
    ) -> LandingWorld:
        """Create the world of a case."""
        ground = load_ground(site(p.site), p.terrain, p.location.bank_seed, p.location.terrain)
        texture = p.preset.ground_texture
        amplitudes = tuple(p.texture * amplitude for amplitude in texture.amplitudes)
        scaled_texture = SiteTexture(coarsest_m=texture.coarsest_m, amplitudes=amplitudes)
        ground = replace(ground, site=p.preset.model_copy(update={"ground_texture": scaled_texture}))
        air = p.preset.environment
        elevation_deg = raise_sun_deg(p.faults, p.sun.elevation_deg)
        sun = sun_at(air, p.sun.azimuth_deg, elevation_deg)
        return cls(ground, sun, p.meshes, sunlight_ratio(air, float(np.radians(elevation_deg)), p.detector))


@dataclass(frozen=True)
class Pair:
    """The two images of a landing case, and their rendered frames."""

    images: tuple[DetectorImage, DetectorImage]  #: delivered images with the true camera
    frames: tuple[Frame, Frame]  #: rendered radiance and ground truth

    @property
    def counts(self) -> tuple[UInt16[np.ndarray, "rows columns"], UInt16[np.ndarray, "rows columns"]]:
        """Detector counts of both images."""
        return self.images[0].counts, self.images[1].counts

    @property
    def axis_range_m(self) -> float:
        """True range along the optical axis of the first image to ground or rock, metres."""
        return self.range_along_m(self.images[0].camera.a)

    def range_along_m(self, axis: Float64[np.ndarray, "3"]) -> float:
        """Compute the true range of the first image along a direction (body axes): median of the four nearest pixels.

        The centres of these pixels are at most 0.7 px from the direction.
        """
        ranges, image = self.frames[0].range_m, self.images[0]
        column, row = image.camera.project(np.array([axis]))[0][0]
        rows_summed = len(ranges) // len(image.counts)
        first_row, first_column = int((row + 0.5) * rows_summed - 0.5), int(column)
        return float(np.median(ranges[first_row : first_row + 2, first_column : first_column + 2]))


def take_images(
    p: LandingScenarioParameters, world: LandingWorld, flight: LandingFlight, optics: Optics, streams: Streams
) -> Pair:
    """Take both images of a flight; the first image determines the exposure of both."""
    parameters = add_detector_faults(p.faults, p.detector)
    detector = Detector.draw(optics.fall_off, parameters, streams.generator("detector response"))
    # a disc at the camera casts the vehicle's shadow; a fault can enlarge it
    shadow_disc_m = max(p.lander.caster_diameter_m, p.faults.vehicle_shadow_m)
    lowest = min(flight.states, key=lambda state: float(state.position_m[2]))
    # one scene for both images, with the level of detail for the lower image
    viewpoint = Viewpoint.from_pose(optics.rays, lowest.world_from_body, world.ground.surface)
    scene = add_meshes(
        site_scene(world.ground, viewpoint, world.sun), world.meshes, (viewpoint.east_m, viewpoint.north_m)
    )
    scene = replace(scene, caster_diameter_m=shadow_disc_m)
    noise = streams.generator("detector noise")
    frames_and_motions = [render_state(p.render.backend, scene, optics, state) for state in flight.states]
    frames, motions = zip(*frames_and_motions, strict=True)
    radiances = [frame.radiance * np.float32(world.brightness) for frame in frames]
    # another name of a random stream would change the random values
    detector = auto_expose(detector, radiances[0], p.exposure, streams.generator("test pictures")).detector
    counts = [detector.expose(radiance, noise, motion) for radiance, motion in zip(radiances, motions, strict=True)]
    # the fault `repeated_image` = 1 replaces image 2
    delivered_images = corrupt_images(counts, 2 * p.faults.repeated_image, p.faults.black_image, p.faults.lost_rows)
    camera = p.detector.delivered_camera(optics.camera)
    first, second = (
        DetectorImage(image, state.time_s, camera, detector.calibration)
        for image, state in zip(delivered_images, flight.states, strict=True)
    )
    return Pair((first, second), (frames[0], frames[1]))


def measure(p: LandingScenarioParameters, flight: LandingFlight, pair: Pair, streams: Streams) -> LandingMeasurements:
    """Simulate the measurements of a case.

    The a-priori site is the point on the first optical axis at the measured range, or at the commanded height if there
    is no range.
    """
    unit = RangingUnit.draw(p.laser, streams.generator("laser"))
    reading = unit.readings(np.zeros(1), np.array([pair.range_along_m(unit.axis)]), streams.generator("laser noise"))
    slant = float(add_range_faults(p.faults, reading.values, p.height_m)[0])
    calibrated = draw_calibrated(p.optics, p.calibration, streams.generator("camera calibration"))
    camera = p.detector.delivered_camera(calibrated)
    first, second = (replace(image, camera=camera) for image in pair.images)
    camera_to_site_m = (slant if np.isfinite(slant) else p.height_m) * camera.a
    return LandingMeasurements(
        images=(first, second),
        poses=flight.poses,
        slant_range_m=slant,
        up_body=flight.up_body,
        apriori_site_world=np.asarray(flight.poses[0].world_from_body.apply(camera_to_site_m)),
    )


#: Spacing of the ground-truth grid divided by the diameter of a footprint: 0.2 m for a footprint of 2 m.
STEP_DIAMETERS = 0.1
#: Width of the margin of relief around the visible ground, in footprint diameters: touchdowns can lie outside it.
MARGIN_DIAMETERS = 1.5
#: True safety of the footprint around a pixel's ground point: safe, unsafe, or partly outside of an image.
SAFE, UNSAFE, UNKNOWN = 0, 1, 255


@dataclass(frozen=True)
class GroundTruth:
    """Ground truth of a flight on a grid aligned with the horizontal axes of the first image."""

    relief: Relief
    limits: Limits
    positions: Float[np.ndarray, "rows columns 2"]  #: world x, y of the grid points
    footprints: Footprints  #: slope and roughness under a lander at each position
    covered: Bool[np.ndarray, "rows columns"]  #: whether both images show the whole footprint
    step_m: float

    @classmethod
    def from_images(cls, world: LandingWorld, flight: LandingFlight, pair: Pair, limits: Limits) -> GroundTruth:
        """Compute the ground truth of the area in the first image."""
        centre = flight.states[0].position_m
        # rows: unit vectors of the image's right and up directions on the ground
        right = flight.states[0].attitude.apply(np.array([1.0, 0.0, 0.0]))[:2]
        right = right / np.hypot(*right)
        axes = np.array([right, [-right[1], right[0]]])
        # outline of the ground in the image; every eighth pixel suffices
        ground_points = pair.frames[0].points_world(np.s_[::8, ::8])[..., :2].reshape(-1, 2)
        hull = cv2.convexHull(ground_points[np.all(np.isfinite(ground_points), axis=1)].astype(np.float32))
        outline = (hull[:, 0].astype(np.float64) - centre[:2]) @ axes.T
        step = STEP_DIAMETERS * limits.diameter_m
        low, high = (np.floor(limit / step) * step for limit in (outline.min(axis=0), outline.max(axis=0)))
        x, y = (np.arange(first, last + 0.5 * step, step) for first, last in zip(low, high, strict=True))
        local = np.stack(np.meshgrid(x, y), axis=-1)
        positions = np.asarray(centre[:2] + local @ axes)
        margin = MARGIN_DIAMETERS * limits.diameter_m
        flat_positions = positions.reshape(-1, 2)
        west_south, east_north = flat_positions.min(axis=0) - margin, flat_positions.max(axis=0) + margin
        spacing = SPACING_DIAMETERS * limits.diameter_m
        relief = Relief.from_ground(world.ground, west_south, east_north, spacing, world.meshes)
        heights = relief.average(positions, relief.spacing_m)
        # grid points on the ground; `visible`: whether both images show them
        points = np.concatenate([flat_positions, heights.reshape(-1, 1)], axis=1)
        visible = np.ones(len(points), dtype=bool)
        for image, state in zip(pair.images, flight.states, strict=True):
            pixels, in_front = image.camera.transform(state.world_from_body).project(points)
            with np.errstate(invalid="ignore"):
                visible &= in_front & np.all((pixels >= 0.0) & (pixels <= np.array(image.camera.size) - 1.0), axis=1)
        distance_to_invisible_m = distance_transform_edt(np.pad(visible.reshape(heights.shape), 1))[1:-1, 1:-1] * step
        covered = distance_to_invisible_m >= 0.5 * limits.diameter_m
        return cls(relief, limits, positions, relief.footprints(positions, limits), covered, step)

    @property
    def safe(self) -> Bool[np.ndarray, "rows columns"]:
        """Safe positions whose whole footprint is in both images."""
        return np.asarray(self.covered & self.footprints.safe)

    @property
    def safe_with_margin(self) -> Bool[np.ndarray, "rows columns"]:
        """Positions around which all positions within one footprint radius are also safe."""
        distance_m = distance_transform_edt(np.pad(self.safe, 1))[1:-1, 1:-1] * self.step_m
        return np.asarray(distance_m > 0.5 * self.limits.diameter_m)

    @property
    def visible_hazards(self) -> Bool[np.ndarray, "rows columns"]:
        """Unsafe positions whose whole footprint is in both images."""
        return np.asarray(self.covered & ~self.footprints.safe)

    def clearance_fraction(self, position: Float[np.ndarray, "2"]) -> float:
        """Compute the distance of a position (x, y) from the nearest visible hazard, divided by the largest distance.

        The largest distance is that of a position whose footprint is in both images. The result is 0 outside of the
        images and without a safe position in them, and NaN without a visible hazard.
        """
        if not np.any(self.visible_hazards):
            return float("nan")
        distances = np.where(self.covered, distance_transform_edt(~self.visible_hazards), 0.0)
        row, column = divmod(
            int(np.argmin(np.hypot(*(self.positions.reshape(-1, 2) - position).T))), distances.shape[1]
        )
        is_outside = np.hypot(*(self.positions[row, column] - position)) > self.step_m
        largest = float(distances.max())
        return 0.0 if is_outside or largest == 0.0 else float(distances[row, column]) / largest

    def distance_to_hazard_m(self, position: Float[np.ndarray, "2"]) -> float:
        """Compute the distance from a position (x, y) to the nearest unsafe grid position."""
        unsafe = self.positions[~self.footprints.safe]
        return float(np.hypot(*(unsafe - position).T).min()) if len(unsafe) else float("inf")

    def classify_points(self, points: Float[np.ndarray, "rows columns 3"]) -> UInt8[np.ndarray, "rows columns"]:
        """Classify the footprint around each ground point (SAFE, UNSAFE, UNKNOWN) by the nearest grid position."""
        origin = self.positions[0, 0]
        axes = np.stack([self.positions[0, 1] - origin, self.positions[1, 0] - origin], axis=1)
        cells = np.linalg.solve(axes, (points[..., :2] - origin).reshape(-1, 2).T).T
        is_inside = np.asarray(np.isfinite(cells).all(axis=1))
        columns, rows = np.rint(np.where(is_inside[:, None], cells, -1.0)).astype(np.int64).T
        shape = self.covered.shape
        is_inside &= (rows >= 0) & (columns >= 0) & (rows < shape[0]) & (columns < shape[1])
        true_class = np.full(len(cells), UNKNOWN, dtype=np.uint8)
        indices = rows[is_inside], columns[is_inside]
        footprint_class = np.where(self.footprints.safe[indices], SAFE, UNSAFE)
        true_class[is_inside] = np.where(self.covered[indices], footprint_class, UNKNOWN)
        return true_class.reshape(points.shape[:2])

    def footprint_at(self, position: Float[np.ndarray, "2"]) -> Footprints | None:
        """Compute slope and roughness under a lander at any position (x, y); None outside the relief."""
        try:
            return self.relief.footprints(position[None], self.limits)
        except ValueError:
            return None


@dataclass(frozen=True)
class RenderedFlight:
    """A flight with its world, images and ground truth."""

    p: LandingScenarioParameters
    world: LandingWorld
    flight: LandingFlight
    pair: Pair
    truth: GroundTruth

    @classmethod
    def simulate(
        cls, p: LandingScenarioParameters, streams: Streams, load_ground: LoadGround = SiteGround.from_bank
    ) -> RenderedFlight:
        """Simulate the flight of a case and take its images."""
        world = LandingWorld.from_parameters(p, load_ground)
        flight = LandingFlight.from_parameters(p, world.ground.surface, streams)
        pair = take_images(p, world, flight, camera_optics(p.optics), streams)
        return cls(p, world, flight, pair, GroundTruth.from_images(world, flight, pair, p.lander.limits))


#: Bounds of the classes of slope or roughness divided by its limit, and the names of the classes.
CLASS_BOUNDS = (1.0, 1.5, 2.0, 3.0)
CLASS_NAMES = ("below_1", "1_to_1.5", "1.5_to_2", "2_to_3", "above_3")
#: Gross (large) hazards: minimum diameter in map cells, and minimum roughness divided by its limit.
MIN_GROSS_CELLS, MIN_GROSS_ROUGHNESS = 3.0, 2.0


@dataclass(frozen=True)
class SampledMap:
    """The algorithm's hazard map, sampled at the truth's grid positions."""

    #: whether the map has slope and roughness at the position, and both images show the whole footprint
    valid: Bool[np.ndarray, "rows columns"]
    safe: Bool[np.ndarray, "rows columns"]  #: whether the map classifies the position as safe
    flagged: Bool[np.ndarray, "rows columns"]  #: whether a hazard cell, before dilation, is under the lander
    slope_rad: Float[np.ndarray, "rows columns"]

    @classmethod
    def sample(
        cls, ground: MappedGround, flight: LandingFlight, truth: GroundTruth, limits: tuple[float, float]
    ) -> SampledMap:
        """Sample the map at the truth's positions; `limits`: the algorithm's slope (rad) and roughness (m) limits."""
        offsets = truth.positions - flight.states[0].position_m[:2]
        local = np.asarray(offsets @ ground.world_from_surface.as_matrix()[:2, :2])
        cells = np.rint(ground.elevation.cells(local)).astype(np.int64)
        shape = np.array(ground.elevation.elevation_m.shape)
        is_inside = np.all((cells >= 0) & (cells < shape), axis=-1) & truth.covered
        rows, columns = np.moveaxis(np.clip(cells, 0, shape - 1), -1, 0)
        hazards = ground.hazards
        with np.errstate(invalid="ignore"):
            is_hazard = (hazards.slope_rad > limits[0]) | (hazards.roughness_m > limits[1])
        radius = 0.5 * truth.limits.diameter_m / ground.elevation.cell_m
        flagged = distance_transform_edt(~is_hazard) <= radius if np.any(is_hazard) else np.zeros_like(is_hazard)
        slope = hazards.slope_rad[rows, columns]
        valid = is_inside & np.isfinite(slope) & np.isfinite(hazards.roughness_m[rows, columns])
        safe = valid & (hazards.safety[rows, columns] == Safety.SAFE)
        return cls(valid, safe, valid & flagged[rows, columns], slope)


def count_hazards(ground: MappedGround, sampled: SampledMap, truth: GroundTruth) -> dict[str, Scalar]:
    """Count footprints by truth and map; sums over cases give rates.

    Footprints are classified by roughness / limit and slope / limit. For each class:

    - `footprints_*`: number of footprints
    - `footprints_*_safe`: number that the map classifies as safe
    - `footprints_*_unflagged`: number without a hazard cell, before the algorithm dilates the hazard cells

    `footprints_called_safe` is the number of all footprints that the map classifies as safe, and
    `footprints_called_safe_unsafe` the number of these footprints that are truly unsafe.

    `gross_*` hazards have at least twice the roughness limit and a diameter of at least three cells. `false_alarms` are
    safe footprints with a hazard cell; `missed` are unsafe footprints without one.
    """
    footprints, valid, safe = truth.footprints, sampled.valid, sampled.safe
    ratios = {
        "roughness": footprints.roughness_m / truth.limits.max_roughness_m,
        "slope": footprints.slope_rad / truth.limits.max_slope_rad,
    }
    diameter_cells = 2.0 * np.sqrt(footprints.exceeding_m2 / np.pi) / ground.elevation.cell_m
    is_gross = footprints.roughness_m >= MIN_GROSS_ROUGHNESS * truth.limits.max_roughness_m
    is_gross &= diameter_cells >= MIN_GROSS_CELLS
    masks = {
        "footprints": valid,
        "footprints_called_safe": safe,
        "footprints_called_safe_unsafe": safe & ~footprints.safe,
        "footprints_truly_safe": valid & footprints.safe,
        "false_alarms": valid & footprints.safe & sampled.flagged,
        "missed": valid & ~footprints.safe & ~sampled.flagged,
        "gross_hazards": valid & is_gross,
        "gross_hazards_called_safe": safe & is_gross,
        "gross_hazards_unflagged": valid & is_gross & ~sampled.flagged,
    }
    for kind, ratio in ratios.items():
        classes = np.digitize(ratio, CLASS_BOUNDS)
        for number, name in enumerate(CLASS_NAMES):
            members = valid & (classes == number)
            column = f"footprints_{kind}_{name}"
            unflagged = members & ~sampled.flagged
            masks |= {column: members, f"{column}_safe": members & safe, f"{column}_unflagged": unflagged}
    return {column: int(np.count_nonzero(mask)) for column, mask in masks.items()}


def map_errors(
    ground: MappedGround, flight: LandingFlight, sampled: SampledMap, truth: GroundTruth
) -> dict[str, Scalar]:
    """Compute the errors of the map's elevation and slope.

    The reference elevation is the mean of the exact heights in a cell, relative to the camera. `bias` is the mean
    error, `rms` the RMS error, `median_error` the median absolute error. `noise` is the robust standard deviation of
    the errors about a fitted plane; it affects roughness. `relief_error_fraction` is `noise` divided by the same
    deviation of the exact heights: it is 1 for a plane, which needs no images, and 0 for an exact map. `outliers` is
    the fraction of errors about the plane beyond five times `noise`. The result is empty for fewer than four cells with
    an elevation.
    """
    rows, columns = np.indices(ground.elevation.elevation_m.shape)
    local = ground.elevation.positions(np.stack([rows, columns], axis=-1).astype(np.float64))
    start = flight.states[0].position_m
    positions = start[:2] + local @ ground.world_from_surface.as_matrix()[:2, :2].T
    exact = truth.relief.average(positions, ground.elevation.cell_m) - start[2]
    error = ground.elevation.elevation_m - exact
    is_finite = np.isfinite(error)
    values = error[is_finite]
    if values.size < 4:  # the fitted plane has three parameters
        return {}
    design = np.column_stack([local[is_finite], np.ones(values.size)])
    residuals = _subtract_plane(design, values)
    noise, relief = _robust_deviation(residuals), _robust_deviation(_subtract_plane(design, exact[is_finite]))
    slope_errors = (sampled.slope_rad - truth.footprints.slope_rad)[sampled.valid]
    has_slopes = slope_errors.size > 0
    return {
        "elevation_bias_m": float(values.mean()),
        "elevation_rms_m": float(np.sqrt(np.mean(values**2))),
        "elevation_median_error_m": float(np.median(np.abs(values))),
        "elevation_noise_m": noise,
        "relief_error_fraction": noise / relief,
        "elevation_outliers": float(np.mean(np.abs(residuals) > 5.0 * noise)),
        "slope_error_bias_deg": float(np.degrees(slope_errors.mean())) if has_slopes else float("nan"),
        "slope_error_rms_deg": float(np.degrees(np.sqrt(np.mean(slope_errors**2)))) if has_slopes else float("nan"),
    }


def _subtract_plane(design: Float[np.ndarray, "n 3"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Subtract the plane that is fitted to the values without their outliers, which are found about a first plane.

    An additional plane in the values does not change the result.
    """
    residuals = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    is_inlier = np.abs(residuals - np.median(residuals)) <= 5.0 * _robust_deviation(residuals)
    return np.asarray(values - design @ np.linalg.lstsq(design[is_inlier], values[is_inlier], rcond=None)[0])


def _robust_deviation(values: Float[np.ndarray, "n"]) -> float:
    """Compute a robust standard deviation of at least 1e-12.

    It is 1.4826 times the median absolute deviation: the ratio of the two for a normal distribution.
    """
    return max(1.4826 * float(np.median(np.abs(values - np.median(values)))), 1e-12)
