"""Simulate and process a run of the field test: flight, sun, attitudes, altitudes and triples (paper, III.D and IV).

The sun is that of Meeus, "Astronomical Algorithms" (1998), chapter 25, low accuracy: accurate to 0.01 deg in this
century, without refraction (0.02 deg at 45 deg of elevation) and parallax (0.002 deg).
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

from marsyard.scenarios.fieldtest.attitude import Targets, add_thermal_drift, sight_targets, solve_attitude
from marsyard.scenarios.fieldtest.parameters import (
    CAMERA,
    ElevationParameters,
    FieldTestParameters,
    RunParameters,
    TripleParameters,
)
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.dynamics.helicopter import HelicopterFlight, helicopter_flight
from marsyard.sim.frames import direction
from marsyard.sim.render import CloudLayer
from marsyard.sim.sensor import preset
from marsyard.sim.sensor.imu import DEG_H, Imu
from marsyard.sim.sensor.inertial import InertialSolution
from marsyard.sim.sensor.instrument import Clock
from marsyard.sim.sensor.satellite_navigation import Gps
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank, site

_Stream = Callable[[str], np.random.Generator]

#: Points of the line whose mean ground is the reference of the flight's heights.
_GROUND_POINTS = 256
#: Posts of the elevation model around the requested points.
_MARGIN = 2
#: Noon of 1 January 2000, and terrestrial less universal time in 2002, s.
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
_TT_LESS_UT_S = 64.3


class Category(StrEnum):
    """The paper's categories of triples."""

    SHORT_TIME = "short time"
    SAME_DIRECTION = "same direction"
    OPPOSITE_DIRECTION = "opposite direction"


@dataclass(frozen=True)
class Pictures:
    """Measurements at a run's pictures, one row per picture in the order taken.

    - flown: number of the pass
    - direction: direction of flight along the line, +1 or -1
    - position_m: by GPS, world axes
    - altitude_m: above the ground, as measured
    - centre_m: intersection of the camera's axis with level ground, by the measured attitude: east, north
    """

    flown: Int64[np.ndarray, "n"]
    direction: Int64[np.ndarray, "n"]
    position_m: Float64[np.ndarray, "n 3"]
    altitude_m: Float64[np.ndarray, "n"]
    centre_m: Float64[np.ndarray, "n 2"]


@dataclass(frozen=True)
class Triple:
    """Three pictures in the order in which DIMES is given them, by their numbers in the run."""

    category: Category
    pictures: tuple[int, int, int]


def make_triples(
    run: RunParameters, pictures: Pictures, parameters: TripleParameters, rng: np.random.Generator
) -> tuple[Triple, ...]:
    """Draw the triples of a run: for each category the stated number out of all candidates.

    Pictures of a short-time triple are consecutive ones of one pass. Those of the other categories have decreasing
    altitudes, as in a landing. Raises ValueError where there are too few candidates.
    """
    # pairs that overlap and whose distance DIMES can measure over the virtual interval
    lower = np.minimum(pictures.altitude_m[:, None], pictures.altitude_m)
    paired = _distances(pictures.centre_m) <= parameters.overlap_fraction * lower
    paired &= _distances(pictures.position_m[:, :2]) <= parameters.max_speed_m_s * parameters.virtual_interval_s
    first = np.arange(len(pictures.flown) - 2)
    in_one_pass = pictures.flown[first] == pictures.flown[first + 2]
    consecutive = first[in_one_pass & paired[first, first + 1] & paired[first + 1, first + 2]]
    # all three pictures with a step down from each to the next, by GPS
    step = pictures.position_m[:, 2][:, None] - pictures.position_m[:, 2]
    follows = paired & (step >= parameters.min_step_m) & (step <= parameters.max_step_m)
    descending = np.array(
        [
            (before, middle, after)
            for middle in range(len(step))
            for before in np.flatnonzero(follows[:, middle])
            for after in np.flatnonzero(follows[middle])
        ],
        dtype=np.int64,
    ).reshape(-1, 3)
    one_direction = (np.diff(pictures.direction[descending], axis=1) == 0).all(axis=1)
    candidates = {
        Category.SHORT_TIME: (consecutive[:, None] + np.arange(3), run.short_time),
        Category.SAME_DIRECTION: (descending[one_direction], run.same_direction),
        Category.OPPOSITE_DIRECTION: (descending[~one_direction], run.opposite_direction),
    }
    made = []
    for category, (possible, wanted) in candidates.items():
        if len(possible) < wanted:
            raise ValueError(
                f"{run.name}: {wanted} triples '{category}' are asked for, but its pictures make {len(possible)}"
            )
        for first, second, third in possible[rng.choice(len(possible), wanted, replace=False)].tolist():
            made.append(Triple(category, (first, second, third)))
    return tuple(made)


def _distances(points: Float64[np.ndarray, "n 2"]) -> Float64[np.ndarray, "n n"]:
    return np.asarray(np.linalg.norm(points[:, None] - points, axis=-1))


def sun_direction(time: datetime, latitude_deg: float, longitude_deg: float) -> Float64[np.ndarray, "3"]:
    """Compute the unit vector to the sun's centre in the local level frame (east, north, up).

    Latitude is geodetic, longitude positive to the east. Raises ValueError for a time without a time zone.
    """
    if time.tzinfo is None:
        raise ValueError(f"the time {time} has no time zone; one is needed, as in 2002-10-15T12:00-07:00")
    days = (time - _J2000).total_seconds() / 86400.0
    t = (days + _TT_LESS_UT_S / 86400.0) / 36525.0  # Julian centuries since J2000
    mean_longitude = 280.46646 + 36000.76983 * t + 0.0003032 * t**2
    anomaly = np.radians(357.52911 + 35999.05029 * t - 0.0001537 * t**2)
    centre = (
        (1.914602 - 0.004817 * t) * np.sin(anomaly)
        + (0.019993 - 0.000101 * t) * np.sin(2.0 * anomaly)
        + 0.000289 * np.sin(3.0 * anomaly)
    )
    node = np.radians(125.04 - 1934.136 * t)
    longitude = np.radians(mean_longitude + centre - 0.00569 - 0.00478 * np.sin(node))
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
    """Inputs of a run: the field test, the run's number in it, the campaign's seed and name."""

    field_test: FieldTestParameters
    number: int
    seed: int
    campaign: str


@dataclass(frozen=True)
class Run:
    """A simulated and processed run.

    - clouds: none for a clear sky; they drift with the flight's time
    - flight: the true motion
    - truth: truth at the pictures taken on the passes
    - pictures: measurements at the pictures
    - attitudes: as processed, at the pictures' time tags
    - triples: the cases made from the pictures
    """

    key: RunKey
    parameters: RunParameters
    clouds: CloudLayer | None
    flight: HelicopterFlight
    truth: Motion
    pictures: Pictures
    attitudes: Rotation
    triples: tuple[Triple, ...]

    def sun(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Return the unit vector to the sun at a time of the flight, world axes."""
        p = self.parameters
        since = timedelta(seconds=time_s - self.flight.passes[0].start_s)
        return sun_direction(p.begins + since, p.latitude_deg, p.longitude_deg)


def survey_ground(
    p: ElevationParameters, surface: Surface, points_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator
) -> RegularGridInterpolator:
    """Survey the ground around points on a grid, linear between posts (paper, III.D.1).

    A post holds the mean height of its cell and a correlated error.
    """
    x, y = (
        p.posting_m * np.arange(np.floor(a / p.posting_m) - _MARGIN, np.ceil(b / p.posting_m) + _MARGIN + 1.0)
        for a, b in zip(points_m.min(axis=0), points_m.max(axis=0), strict=True)
    )
    level = int(np.clip(np.rint(np.log2(p.posting_m / surface.spacing_m)), 0, len(surface.levels) - 1))
    ground = surface.height(*np.meshgrid(x, y, indexing="ij"), level)
    sigma = p.correlation_m / p.posting_m
    error = gaussian_filter(rng.standard_normal(ground.shape), sigma, mode="wrap")
    # white noise smoothed by a Gaussian keeps 1 / (4 pi sigma**2) of its variance
    error *= p.error_m * np.sqrt(4.0 * np.pi) * sigma
    return RegularGridInterpolator((x, y), ground + error)


def simulate_run(key: RunKey) -> Run:
    """Simulate and process a run; a function of the key alone."""
    p, run = key.field_test, key.field_test.runs[key.number]

    def stream(name: str) -> np.random.Generator:
        """Return a stream that all cases of the run share: named by the run, not by a case."""
        return Streams(key.seed, key.campaign, 0).generator(f"run {run.name}: {name}")

    surface = TerrainBank(p.terrain(run.site), p.bank_seed).terrain(0)
    # a line of random position and azimuth; heights count from the mean ground under it
    rng = stream("flight")
    middle, azimuth = rng.uniform(0.0, surface.period_m, 2), float(rng.uniform(0.0, 2.0 * np.pi))
    steps = np.linspace(-0.5, 0.5, _GROUND_POINTS) * p.helicopter.length_m
    line = surface.height(middle[0] + steps * np.sin(azimuth), middle[1] + steps * np.cos(azimuth))
    origin = np.array([*middle, float(line.mean())])
    flight = helicopter_flight(p.helicopter, origin, azimuth, site(run.site).environment.gravity_m_s2, rng)
    step = p.pictures.interval_s
    times_of_pass = [np.arange(one.start_s + 0.5 * step, one.end_s, step) for one in flight.passes]
    times = np.concatenate(times_of_pass)
    passes = np.repeat(np.arange(len(times_of_pass)), [part.size for part in times_of_pass])
    clock = Clock.draw(p.pictures.clock, stream("camera clock"))
    gps = Gps.draw(p.gps, flight.span_s, stream("gps"))
    position = gps.measure(flight, times, stream("gps noise")).values
    solution = _estimate_attitudes(p, surface, flight, clock, gps, stream)
    attitudes = solution.attitude(clock.tags(times, stream("picture tags")))
    horizontal = np.ascontiguousarray(position[:, :2])
    posts = survey_ground(p.elevation, surface, horizontal, stream("elevation model"))
    interpolation = stream("elevation interpolation").standard_normal(len(horizontal))
    altitude = position[:, 2] - (posts(horizontal) + p.elevation.interpolation_m * interpolation)
    down = attitudes.apply(np.array([0.0, 0.0, -1.0]))
    pictures = Pictures(
        flown=np.array([one.number for one in flight.passes], dtype=np.int64)[passes],
        direction=np.array([one.direction for one in flight.passes], dtype=np.int64)[passes],
        position_m=position,
        altitude_m=altitude,
        centre_m=horizontal + (altitude / -down[:, 2])[:, None] * down[:, :2],
    )
    clouds = None
    if run.clouds is not None:
        clouds = CloudLayer.draw(run.clouds, stream("clouds"), ground_m=float(flight.origin_m[2]))
    return Run(
        key=key,
        parameters=run,
        clouds=clouds,
        flight=flight,
        truth=flight.motion(times),
        pictures=pictures,
        attitudes=attitudes,
        triples=make_triples(run, pictures, p.triples, stream("triples")),
    )


def _estimate_attitudes(
    p: FieldTestParameters, surface: Surface, flight: HelicopterFlight, clock: Clock, gps: Gps, stream: _Stream
) -> InertialSolution:
    """Simulate both passes over the targets and the gyros, and estimate the attitude over the flight."""
    camera, noise, sightings = field_camera(), stream("sightings"), []
    targets = Targets.draw(p.targets, surface, flight.origin_m[:2], stream("targets"))
    for start, end in flight.fly_overs_s:
        times = np.linspace(start, end, p.targets.pictures + 2)[1:-1]
        tags = clock.tags(times, noise)
        fixes = gps.measure(flight, times, noise).values
        motion = flight.motion(times)
        sightings.append(sight_targets(targets, camera, motion, tags, fixes, p.targets.centroid_px, noise))
    unit = Imu.draw(p.imu, flight.span_s, stream("imu errors"))
    increments = unit.increments(flight, *flight.span_s, stream("imu noise"))
    middle = np.array(camera.size) / 2.0
    _, directions = camera.rays(np.stack([middle, middle + np.array([1.0, 0.0])]))
    pixel_rad = float(np.linalg.norm(directions[1] - directions[0]))
    # the larger of a centroid's error and the residual error of GPS
    sd = max(p.targets.centroid_px * pixel_rad, p.gps.horizontal_wander_m / p.helicopter.fly_over_m)
    drifted = add_thermal_drift(increments, p.drift, flight, flight.span_s[0])
    return solve_attitude(drifted, sightings[0], sightings[1], sd, p.imu.gyro_bias_deg_h * DEG_H)


def field_camera() -> CameraModel:
    """Return the field test's camera in the body frame."""
    (camera,) = preset(CAMERA).cameras()
    return camera
