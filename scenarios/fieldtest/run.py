"""Simulate and process a run of the field test: flight, attitudes, altitudes and triples (paper, III.D)."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.attitude import (
    AttitudeSolution,
    Targets,
    add_thermal_drift,
    sight_targets,
    solve_attitude,
)
from marsyard.scenarios.fieldtest.ephemeris import sun_direction
from marsyard.scenarios.fieldtest.parameters import (
    CAMERA,
    ElevationParameters,
    FieldTestParameters,
    RunParameters,
)
from marsyard.scenarios.fieldtest.triples import Pictures, Triple, make_triples
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.dynamics.helicopter import HelicopterFlight, helicopter_flight
from marsyard.sim.render import CloudLayer
from marsyard.sim.sensor import preset
from marsyard.sim.sensor.imu import DEG_H, Imu
from marsyard.sim.sensor.instrument import Clock
from marsyard.sim.sensor.satellite_navigation import Gps
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank, site

#: Points of the line whose mean ground is the reference of the flight's heights.
_GROUND_POINTS = 256
#: Posts of the elevation model around the requested points.
_MARGIN = 2


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
    attitude_solution: AttitudeSolution
    triples: tuple[Triple, ...]

    def sun(self, time_s: float) -> Float64[np.ndarray, "3"]:
        """Return the unit vector to the sun at a time of the flight, world axes."""
        p = self.parameters
        since = timedelta(seconds=time_s - self.flight.passes[0].start_s)
        return sun_direction(p.begins + since, p.latitude_deg, p.longitude_deg)


@dataclass(frozen=True)
class ElevationModel:
    """Heights on a grid, with errors; linear between posts (paper, III.D.1)."""

    posts: RegularGridInterpolator
    interpolation_m: float

    @classmethod
    def surveyed(
        cls, p: ElevationParameters, surface: Surface, points_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator
    ) -> ElevationModel:
        """Survey the ground around these points; a post holds the mean height of its cell and a correlated error."""
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
        return cls(RegularGridInterpolator((x, y), ground + error), p.interpolation_m)

    def heights(self, points_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator) -> Float64[np.ndarray, "n"]:
        """Interpolate heights, metres, with the error of interpolation."""
        return np.asarray(self.posts(points_m) + self.interpolation_m * rng.standard_normal(len(points_m)))


def simulate_run(key: RunKey) -> Run:
    """Simulate and process a run; a function of the key alone."""
    p, run = key.field_test, key.field_test.runs[key.number]
    streams = _RunStreams(Streams(key.seed, key.campaign, 0), run.name)
    surface = TerrainBank(p.terrain(run.site), p.bank_seed).terrain(0)
    flight = _draw_flight(p, run, surface, streams.generator("flight"))
    step = p.pictures.interval_s
    times_of_pass = [np.arange(one.start_s + 0.5 * step, one.end_s, step) for one in flight.passes]
    times = np.concatenate(times_of_pass)
    passes = np.repeat(np.arange(len(times_of_pass)), [part.size for part in times_of_pass])
    clock = Clock.drawn(p.pictures.clock, streams.generator("camera clock"))
    gps = Gps.drawn(p.gps, flight.span_s, streams.generator("gps"))
    position = gps.measure(flight, times, streams.generator("gps noise")).values
    solution = _estimate_attitudes(p, surface, flight, clock, gps, streams)
    attitudes = solution.inertial.attitude(clock.tags(times, streams.generator("picture tags")))
    horizontal = np.ascontiguousarray(position[:, :2])
    model = ElevationModel.surveyed(p.elevation, surface, horizontal, streams.generator("elevation model"))
    altitude = position[:, 2] - model.heights(horizontal, streams.generator("elevation interpolation"))
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
        clouds = CloudLayer.draw(run.clouds, streams.generator("clouds"), ground_m=float(flight.origin_m[2]))
    return Run(
        key=key,
        parameters=run,
        clouds=clouds,
        flight=flight,
        truth=flight.motion(times),
        pictures=pictures,
        attitudes=attitudes,
        attitude_solution=solution,
        triples=make_triples(run, pictures, p.triples, streams.generator("triples")),
    )


@dataclass(frozen=True)
class _RunStreams:
    """Streams of a run that all its cases share: named by the run, not by a case."""

    streams: Streams
    run: str

    def generator(self, name: str) -> np.random.Generator:
        return self.streams.generator(f"run {self.run}: {name}")


def _draw_flight(
    p: FieldTestParameters, run: RunParameters, surface: Surface, rng: np.random.Generator
) -> HelicopterFlight:
    """Draw the flight with a random position and azimuth of its line."""
    middle = rng.uniform(0.0, surface.period_m, 2)
    azimuth = float(rng.uniform(0.0, 2.0 * np.pi))
    steps = np.linspace(-0.5, 0.5, _GROUND_POINTS) * p.helicopter.length_m
    ground = surface.height(middle[0] + steps * np.sin(azimuth), middle[1] + steps * np.cos(azimuth))
    origin = np.array([*middle, float(ground.mean())])
    return helicopter_flight(p.helicopter, origin, azimuth, site(run.site).environment.gravity_m_s2, rng)


def _estimate_attitudes(
    p: FieldTestParameters, surface: Surface, flight: HelicopterFlight, clock: Clock, gps: Gps, streams: _RunStreams
) -> AttitudeSolution:
    """Simulate both passes over the targets and the gyros, and estimate the attitude over the flight."""
    camera = field_camera()
    targets = Targets.drawn(p.targets, surface, flight.origin_m[:2], streams.generator("targets"))
    noise = streams.generator("sightings")
    sightings = []
    for start, end in flight.fly_overs_s:
        times = np.linspace(start, end, p.targets.pictures + 2)[1:-1]
        tags = clock.tags(times, noise)
        fixes = gps.measure(flight, times, noise).values
        sightings.append(
            sight_targets(targets, camera, flight.motion(times), tags, fixes, p.targets.centroid_px, noise)
        )
    unit = Imu.drawn(p.imu, flight.span_s, streams.generator("imu errors"))
    increments = unit.increments(flight, *flight.span_s, streams.generator("imu noise"))
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
