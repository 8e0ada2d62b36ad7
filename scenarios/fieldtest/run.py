"""Simulate and process a run of the field test: flight, sun, attitudes, altitudes and triples (paper, III.D and IV).

The sun's direction is computed by the method of low accuracy in Meeus, "Astronomical Algorithms" (1998), chapter 25.
The error is 0.01 deg in this century. Refraction (0.02 deg at 45 deg of elevation) and parallax (0.002 deg) are
neglected.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum

import numpy as np
from jaxtyping import Float64, Int64
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.attitude import (
    EarthRotation,
    InertialTrajectory,
    Targets,
    add_thermal_drift,
    sight_targets,
    solve_attitude,
)
from marsyard.scenarios.fieldtest.parameters import (
    CAMERA,
    ElevationParameters,
    FieldTestParameters,
    RunParameters,
    TripleParameters,
)
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.dynamics.helicopter import HelicopterFlight, draw_helicopter_flight
from marsyard.sim.frames import direction
from marsyard.sim.render import CloudLayer
from marsyard.sim.sensor import preset
from marsyard.sim.sensor.imu import DEG_H, Imu
from marsyard.sim.sensor.inertial import InertialSolution
from marsyard.sim.sensor.instrument import Clock
from marsyard.sim.sensor.satellite_navigation import Gps
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank, site

_Generators = Callable[[str], np.random.Generator]

#: Number of points on the flight line whose mean ground height is the reference of the flight's heights.
_GROUND_POINTS = 256
#: Margin of the elevation model around the requested points, posts.
_MARGIN = 2
#: Noon of 1 January 2000, and terrestrial time minus universal time in 2002, s.
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_TT_MINUS_UT_S = 64.3


class Category(StrEnum):
    """The paper's categories of triples."""

    SHORT_TIME = "short time"
    SAME_DIRECTION = "same direction"
    OPPOSITE_DIRECTION = "opposite direction"


@dataclass(frozen=True)
class ImageMeasurements:
    """Measurements at a run's images, one row per image in the order taken.

    - pass_number: number of the pass
    - direction: direction of flight along the line, +1 or -1
    - position_m: GPS position, world axes
    - altitude_m: measured altitude above the ground
    - centre_m: intersection (east, north) of the optical axis with level ground, from the measured attitude
    """

    pass_number: Int64[np.ndarray, "n"]
    direction: Int64[np.ndarray, "n"]
    position_m: Float64[np.ndarray, "n 3"]
    altitude_m: Float64[np.ndarray, "n"]
    centre_m: Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Triple:
    """Category of three images, and their indices among the run's images in the input order of DIMES."""

    category: Category
    image_indices: tuple[int, int, int]


def draw_triples(
    run: RunParameters, images: ImageMeasurements, parameters: TripleParameters, rng: np.random.Generator
) -> tuple[Triple, ...]:
    """Draw the triples of a run: for each category the specified number out of all candidates.

    A short-time triple consists of consecutive images of one pass. Triples of the other categories have decreasing
    altitudes, as in a landing. Raises ValueError if there are too few candidates.
    """
    # pairs that overlap and whose distance DIMES can measure over the virtual interval
    min_altitude = np.minimum(images.altitude_m[:, None], images.altitude_m)
    is_pair = _pairwise_distances(images.centre_m) <= parameters.overlap_fraction * min_altitude
    is_pair &= _pairwise_distances(images.position_m[:, :2]) <= parameters.max_speed_m_s * parameters.virtual_interval_s
    first = np.arange(len(images.pass_number) - 2)
    in_one_pass = images.pass_number[first] == images.pass_number[first + 2]
    consecutive = first[in_one_pass & is_pair[first, first + 1] & is_pair[first + 1, first + 2]]
    # all triples whose GPS height decreases by a permitted step from image to image
    step = images.position_m[:, 2][:, None] - images.position_m[:, 2]
    is_step = is_pair & (step >= parameters.min_step_m) & (step <= parameters.max_step_m)
    descending = np.array(
        [
            (upper, centre, lower)
            for centre in range(len(step))
            for upper in np.flatnonzero(is_step[:, centre])
            for lower in np.flatnonzero(is_step[centre])
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    same_direction = (np.diff(images.direction[descending], axis=1) == 0).all(axis=1)
    candidates = {
        Category.SHORT_TIME: (consecutive[:, None] + np.arange(3), run.short_time),
        Category.SAME_DIRECTION: (descending[same_direction], run.same_direction),
        Category.OPPOSITE_DIRECTION: (descending[~same_direction], run.opposite_direction),
    }
    triples = []
    for category, (indices, count) in candidates.items():
        if len(indices) < count:
            raise ValueError(f"{run.name}: {count} triples '{category}' are requested, but only {len(indices)} exist")
        for first, second, third in indices[rng.choice(len(indices), count, replace=False)].tolist():
            triples.append(Triple(category, (first, second, third)))
    return tuple(triples)


def _pairwise_distances(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n n"]:
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=-1))


def sun_direction(time: datetime, latitude_deg: float, longitude_deg: float) -> Float64[np.ndarray, "3"]:
    """Compute the unit vector to the sun's centre in the local level frame (east, north, up).

    Latitude is geodetic, longitude positive to the east. Raises ValueError for a time without a time zone.
    """
    if time.tzinfo is None:
        raise ValueError(f"the time {time} has no time zone; it needs one, as in 2002-10-15T12:00-07:00")
    days = (time - _J2000).total_seconds() / 86400.0
    t = (days + _TT_MINUS_UT_S / 86400.0) / 36525.0  # Julian centuries since J2000
    # Meeus 25.2 to 25.8: mean longitude and anomaly, equation of centre, apparent longitude (nutation, aberration)
    mean_longitude = 280.46646 + 36000.76983 * t + 0.0003032 * t**2
    anomaly = np.radians(357.52911 + 35999.05029 * t - 0.0001537 * t**2)
    equation_of_centre = (
        (1.914602 - 0.004817 * t) * np.sin(anomaly)
        + (0.019993 - 0.000101 * t) * np.sin(2.0 * anomaly)
        + 0.000289 * np.sin(3.0 * anomaly)
    )
    node = np.radians(125.04 - 1934.136 * t)
    longitude = np.radians(mean_longitude + equation_of_centre - 0.00569 - 0.00478 * np.sin(node))
    obliquity = np.radians(23.4392911 - 0.0130042 * t + 0.00256 * np.cos(node))
    right_ascension = np.arctan2(np.cos(obliquity) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(obliquity) * np.sin(longitude))
    # mean sidereal time at Greenwich (Meeus 12.4); nutation, at most 0.005 deg, is neglected
    sidereal = np.radians((280.46061837 + 360.98564736629 * days + longitude_deg) % 360.0)
    hour = sidereal - right_ascension
    latitude = np.radians(latitude_deg)
    elevation = np.arcsin(
        np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
    )
    east = -np.cos(declination) * np.sin(hour)
    north = np.sin(declination) * np.cos(latitude) - np.cos(declination) * np.sin(latitude) * np.cos(hour)
    return direction(float(np.arctan2(east, north)), float(elevation))


@dataclass(frozen=True)
class RunKey:
    """Inputs that determine a run: the field test, the run's index in it, the campaign's seed and name."""

    field_test: FieldTestParameters
    number: int
    seed: int
    campaign: str


@dataclass(frozen=True)
class Run:
    """A simulated and processed run.

    - clouds: clouds that drift with the flight's time; None for a clear sky
    - flight: the true motion
    - truth: true motion at the images of the passes
    - images: measurements at the images
    - attitudes: estimated attitudes at the images' time tags
    - triples: triples of the run, one per case
    """

    key: RunKey
    parameters: RunParameters
    clouds: CloudLayer | None
    flight: HelicopterFlight
    truth: Motion
    images: ImageMeasurements
    attitudes: Rotation
    triples: tuple[Triple, ...]

    def sun(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Return the unit vector to the sun at a time of the flight, world axes."""
        p = self.parameters
        elapsed = timedelta(seconds=time_s - self.flight.passes[0].start_s)
        return sun_direction(p.begins + elapsed, p.latitude_deg, p.longitude_deg)


def survey_ground(
    p: ElevationParameters, surface: Surface, points_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator
) -> RegularGridInterpolator:
    """Simulate an elevation model of the ground around points; heights are linear between posts (paper, III.D.1).

    The height of a post is the mean height of its cell plus a correlated error.
    """
    x, y = (
        p.posting_m * np.arange(np.floor(low / p.posting_m) - _MARGIN, np.ceil(high / p.posting_m) + _MARGIN + 1.0)
        for low, high in zip(points_m.min(axis=0), points_m.max(axis=0), strict=True)
    )
    level = int(np.clip(np.rint(np.log2(p.posting_m / surface.spacing_m)), 0, len(surface.levels) - 1))
    ground = surface.height(*np.meshgrid(x, y, indexing="ij"), level)
    sigma = p.correlation_m / p.posting_m
    error = gaussian_filter(rng.standard_normal(ground.shape), sigma, mode="wrap")
    # Gaussian smoothing reduces the variance of white noise to the fraction 1 / (4 pi sigma**2)
    error *= p.error_m * np.sqrt(4.0 * np.pi) * sigma
    return RegularGridInterpolator((x, y), ground + error)


def simulate_run(key: RunKey) -> Run:
    """Simulate and process a run; the result depends only on the key."""
    p, run = key.field_test, key.field_test.runs[key.number]

    def generator(name: str) -> np.random.Generator:
        """Create a generator that is the same for all cases of the run."""
        return Streams(key.seed, key.campaign, 0).generator(f"run {run.name}: {name}")

    surface = TerrainBank(p.terrain(run.site), p.bank_seed).terrain(0)
    # flight line with random position and azimuth; heights refer to the mean ground below it
    rng = generator("flight")
    centre, azimuth = rng.uniform(0.0, surface.period_m, 2), float(rng.uniform(0.0, 2.0 * np.pi))
    offsets = np.linspace(-0.5, 0.5, _GROUND_POINTS) * p.helicopter.length_m
    line_heights = surface.height(centre[0] + offsets * np.sin(azimuth), centre[1] + offsets * np.cos(azimuth))
    origin = np.array([*centre, float(line_heights.mean())])
    flight = draw_helicopter_flight(p.helicopter, origin, azimuth, site(run.site).environment.gravity_m_s2, rng)
    interval = p.pictures.interval_s
    pass_times = [np.arange(leg.start_s + 0.5 * interval, leg.end_s, interval) for leg in flight.passes]
    times = np.concatenate(pass_times)
    pass_indices = np.repeat(np.arange(len(pass_times)), [times.size for times in pass_times])
    clock = Clock.draw(p.pictures.clock, generator("camera clock"))
    gps = Gps.draw(p.gps, flight.span_s, generator("gps"))
    position = gps.measure(flight, times, generator("gps noise")).values
    earth = EarthRotation.at_latitude(run.latitude_deg)
    solution = _estimate_attitudes(p, surface, flight, clock, gps, earth, generator)
    attitudes = solution.attitude(clock.tags(times, generator("picture tags")))
    horizontal = np.ascontiguousarray(position[:, :2])
    elevation_model = survey_ground(p.elevation, surface, horizontal, generator("elevation model"))
    interpolation = generator("elevation interpolation").standard_normal(len(horizontal))
    altitude = position[:, 2] - (elevation_model(horizontal) + p.elevation.interpolation_m * interpolation)
    down = attitudes.apply(np.array([0.0, 0.0, -1.0]))
    images = ImageMeasurements(
        pass_number=np.array([leg.number for leg in flight.passes], dtype=np.int64)[pass_indices],
        direction=np.array([leg.direction for leg in flight.passes], dtype=np.int64)[pass_indices],
        position_m=position,
        altitude_m=altitude,
        centre_m=horizontal + (altitude / -down[:, 2])[:, None] * down[:, :2],
    )
    clouds = None
    if run.clouds is not None:
        clouds = CloudLayer.draw(run.clouds, generator("clouds"), ground_m=float(flight.origin_m[2]))
    return Run(
        key=key,
        parameters=run,
        clouds=clouds,
        flight=flight,
        truth=flight.motion(times),
        images=images,
        attitudes=attitudes,
        triples=draw_triples(run, images, p.triples, generator("triples")),
    )


def _estimate_attitudes(
    p: FieldTestParameters,
    surface: Surface,
    flight: HelicopterFlight,
    clock: Clock,
    gps: Gps,
    earth: EarthRotation,
    generator: _Generators,
) -> InertialSolution:
    """Simulate both passes over the targets and the gyros, and estimate the attitude over the flight."""
    camera, noise, sightings = field_camera(), generator("sightings"), []
    targets = Targets.draw(p.targets, surface, flight.origin_m[:2], generator("targets"))
    for start, end in flight.fly_overs_s:
        times = np.linspace(start, end, p.targets.pictures + 2)[1:-1]
        tags = clock.tags(times, noise)
        fixes = gps.measure(flight, times, noise).values
        motion = flight.motion(times)
        sightings.append(sight_targets(targets, camera, motion, tags, fixes, p.targets.centroid_px, earth, noise))
    unit = Imu.draw(p.imu, flight.span_s, generator("imu errors"))
    increments = unit.increments(InertialTrajectory(flight, earth), *flight.span_s, generator("imu noise"))
    centre = np.array(camera.size) / 2.0
    _, directions = camera.rays(np.stack([centre, centre + np.array([1.0, 0.0])]))
    pixel_rad = float(np.linalg.norm(directions[1] - directions[0]))
    # the larger of a centroid's error and the remaining GPS error, as angles
    sd = max(p.targets.centroid_px * pixel_rad, p.gps.horizontal_wander_m / p.helicopter.fly_over_m)
    increments = add_thermal_drift(increments, p.drift, flight, flight.span_s[0])
    return solve_attitude(increments, sightings[0], sightings[1], sd, p.imu.gyro_bias_deg_h * DEG_H, earth)


def field_camera() -> CameraModel:
    """Return the field test's camera in the body frame."""
    (camera,) = preset(CAMERA).cameras()
    return camera
