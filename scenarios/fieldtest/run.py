"""A run of the field test: its flight, what was logged, and what the processing made of it (paper, III.D).

A run is a function of the parameters, the campaign's seed and the run's number.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.attitude import AttitudeSolution, Sightings, solve_attitude
from marsyard.scenarios.fieldtest.drift import with_drift
from marsyard.scenarios.fieldtest.elevation import ElevationModel
from marsyard.scenarios.fieldtest.ephemeris import sun_direction
from marsyard.scenarios.fieldtest.parameters import CAMERA, FieldTestParameters, RunParameters
from marsyard.scenarios.fieldtest.targets import Targets, sight_targets
from marsyard.scenarios.fieldtest.triples import Pictures, Triple, make_triples
from marsyard.sim.camera import CameraModel
from marsyard.sim.dynamics import Motion
from marsyard.sim.dynamics.helicopter import HelicopterFlight, helicopter_flight
from marsyard.sim.render import CloudLayer
from marsyard.sim.sensor import preset
from marsyard.sim.sensor.clock import Clock
from marsyard.sim.sensor.gps import Gps
from marsyard.sim.sensor.imu import DEG_H, Imu
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface, TerrainBank, site

#: Points of the line whose mean ground is the level above which heights of the flight count.
_LEVEL_POINTS = 256


@dataclass(frozen=True)
class RunKey:
    """What a run depends on: the field test, the run's number in it, the campaign's seed and name."""

    field_test: FieldTestParameters
    number: int
    seed: int
    campaign: str


@dataclass(frozen=True)
class Run:
    """A run worked out.

    Attributes
    ----------
    key
        What it depends on.
    parameters
        The run as stated.
    clouds
        The clouds over it; None for a clear sky. They drift with the flight's time.
    flight
        The true motion.
    truth
        Truth at the pictures taken on the passes.
    pictures
        What is known of them.
    attitudes
        As processed, at the pictures' time tags.
    attitude_solution
        How they were found.
    triples
        The cases made of them.
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
        """Unit vector to the sun at a time of the flight, world axes."""
        p = self.parameters
        since = timedelta(seconds=time_s - self.flight.passes[0].start_s)
        return sun_direction(p.begins + since, p.latitude_deg, p.longitude_deg)


def work_out(key: RunKey) -> Run:
    """A run of a field test: its flight logged and processed."""
    p, run = key.field_test, key.field_test.runs[key.number]
    streams = _RunStreams(Streams(key.seed, key.campaign, 0), run.name)
    surface = TerrainBank(p.terrain(run.site), p.bank_seed).terrain(0)
    flight = _flight(p, run, surface, streams.generator("flight"))
    times, flown = _exposures(p, flight)
    clock = Clock.drawn(p.pictures.clock, streams.generator("camera clock"))
    gps = Gps.drawn(p.gps, flight.span_s, streams.generator("gps"))
    position = gps.measure(flight, times, streams.generator("gps noise")).values
    solution = _attitudes(p, surface, flight, clock, gps, streams)
    attitudes = solution.attitudes(clock.tags(times, streams.generator("picture tags")))
    pictures = _pictures(p, surface, flight, flown, position, attitudes, streams)
    return Run(
        key=key,
        parameters=run,
        clouds=_clouds(run, float(flight.origin_m[2]), streams.generator("clouds")),
        flight=flight,
        truth=flight.motion(times),
        pictures=pictures,
        attitudes=attitudes,
        attitude_solution=solution,
        triples=make_triples(run, pictures, p.triples, streams.generator("triples")),
    )


@dataclass(frozen=True)
class _RunStreams:
    """Streams of a run, which all its cases share: they are named by it, and belong to no case."""

    streams: Streams
    run: str

    def generator(self, name: str) -> np.random.Generator:
        return self.streams.generator(f"run {self.run}: {name}")


def _flight(p: FieldTestParameters, run: RunParameters, surface: Surface, rng: np.random.Generator) -> HelicopterFlight:
    """The flight, its line laid anywhere over the site's terrain and in any direction."""
    middle = rng.uniform(0.0, surface.period_m, 2)
    azimuth = float(rng.uniform(0.0, 2.0 * np.pi))
    steps = np.linspace(-0.5, 0.5, _LEVEL_POINTS) * p.helicopter.length_m
    ground = surface.height(middle[0] + steps * np.sin(azimuth), middle[1] + steps * np.cos(azimuth))
    origin = np.array([*middle, float(ground.mean())])
    return helicopter_flight(p.helicopter, origin, azimuth, site(run.site).environment.gravity_m_s2, rng)


def _clouds(run: RunParameters, ground_m: float, rng: np.random.Generator) -> CloudLayer | None:
    return None if run.clouds is None else CloudLayer.draw(run.clouds, rng, ground_m=ground_m)


def _pictures(
    p: FieldTestParameters,
    surface: Surface,
    flight: HelicopterFlight,
    flown: Int64[np.ndarray, "n"],
    position_m: Float64[np.ndarray, "n 3"],
    attitudes: Rotation,
    streams: _RunStreams,
) -> Pictures:
    """What is known of the pictures: altitude by GPS and the elevation model, and where each is centred."""
    places = np.ascontiguousarray(position_m[:, :2])
    model = ElevationModel.surveyed(p.elevation, surface, places, streams.generator("elevation model"))
    altitude = position_m[:, 2] - model.heights(places, streams.generator("elevation interpolation"))
    down = attitudes.apply(np.array([0.0, 0.0, -1.0]))
    centre = places + (altitude / -down[:, 2])[:, None] * down[:, :2]
    direction = np.array([flight.passes[number].direction for number in flown], dtype=np.int64)
    return Pictures(flown, direction, position_m, altitude, centre)


def _exposures(
    p: FieldTestParameters, flight: HelicopterFlight
) -> tuple[Float64[np.ndarray, "n"], Int64[np.ndarray, "n"]]:
    """Times of the pictures on the passes, and the pass of each."""
    step = p.pictures.interval_s
    of_each = [np.arange(one.start_s + 0.5 * step, one.end_s, step) for one in flight.passes]
    numbers = [
        np.full(times.size, one.number, dtype=np.int64) for times, one in zip(of_each, flight.passes, strict=True)
    ]
    return np.concatenate(of_each), np.concatenate(numbers)


def _attitudes(
    p: FieldTestParameters,
    surface: Surface,
    flight: HelicopterFlight,
    clock: Clock,
    gps: Gps,
    streams: _RunStreams,
) -> AttitudeSolution:
    """Attitude over the flight from the gyros and both passes over the targets."""
    camera = field_camera()
    targets = Targets.placed(p.targets, surface, flight.origin_m[:2], streams.generator("targets"))
    noise = streams.generator("sightings")
    sightings: list[Sightings] = []
    for start, end in flight.fly_overs_s:
        times = np.linspace(start, end, p.targets.pictures + 2)[1:-1]
        tags = clock.tags(times, noise)
        fixes = gps.measure(flight, times, noise).values
        sightings.append(
            sight_targets(targets, camera, flight.motion(times), tags, fixes, p.targets.centroid_px, noise)
        )
    unit = Imu.drawn(p.imu, flight.span_s, streams.generator("imu errors"))
    delivered = unit.increments(flight, *flight.span_s, streams.generator("imu noise"))
    increments = with_drift(delivered, p.drift, flight, flight.span_s[0])
    pixel_rad = _pixel_rad(camera)
    # a centroid's error, or what GPS leaves, whichever is larger
    sd = max(p.targets.centroid_px * pixel_rad, p.gps.horizontal_wander_m / p.helicopter.fly_over_m)
    return solve_attitude(increments, sightings[0], sightings[1], sd, p.imu.gyro_bias_deg_h * DEG_H)


def field_camera() -> CameraModel:
    """The field test's camera in the body frame."""
    (camera,) = preset(CAMERA).cameras()
    return camera


def _pixel_rad(camera: CameraModel) -> float:
    """Angle of a pixel in the middle of the picture."""
    columns, rows = camera.size
    middle = np.array([columns / 2.0, rows / 2.0])
    _, directions = camera.rays(np.stack([middle, middle + np.array([1.0, 0.0])]))
    return float(np.linalg.norm(directions[1] - directions[0]))
