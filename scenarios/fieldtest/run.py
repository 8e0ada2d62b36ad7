"""Simulation of a run of the field test, and its processing: attitudes, altitudes and triples of its images."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from marsyard.scenarios.fieldtest.attitude import EarthRotation, InertialTrajectory, add_thermal_drift, solve_attitude
from marsyard.scenarios.fieldtest.flight import FlownRun, RunKey, field_camera
from marsyard.scenarios.fieldtest.images import build_start_scene, run_ground, take_image
from marsyard.scenarios.fieldtest.parameters import ElevationParameters
from marsyard.scenarios.fieldtest.targets import Sightings, Targets, detect_targets, project_targets
from marsyard.scenarios.fieldtest.triples import ImageMeasurements, Triple, draw_triples
from marsyard.scenarios.views import SiteGround
from marsyard.sim.dynamics import Motion
from marsyard.sim.dynamics.helicopter import draw_helicopter_flight
from marsyard.sim.render import CloudLayer, Objects
from marsyard.sim.sensor.gps import Gps
from marsyard.sim.sensor.imu import DEG_H, Imu
from marsyard.sim.sensor.inertial import InertialSolution
from marsyard.sim.sensor.instrument import Clock
from marsyard.sim.terrain import Surface, site

#: Margin of the elevation model around the requested points, posts.
_MARGIN_POSTS = 2
#: Number of points on the flight line whose mean ground height is the reference of the flight's heights.
_GROUND_POINTS = 256
#: Rays along each side of a pixel at the edges of the targets.
_TARGET_EDGE_RAYS = 4
#: Minimum number of sightings of a pass: two directions determine an attitude, one more checks it.
_MIN_SIGHTINGS = 3
#: Spacing of the mesh at the centre of the scene, in samples of the terrain; it increases outwards.
_MESH_SAMPLES = 0.67


def simulate_elevation_model(
    p: ElevationParameters, surface: Surface, points_m: Float64[np.ndarray, "n 2"], rng: np.random.Generator
) -> RegularGridInterpolator:
    """Simulate an elevation model of the ground around points; heights are linear between posts (paper, III.D.1).

    The height of a post is the mean height of its cell plus a correlated error.
    """
    x, y = (
        p.posting_m * np.arange(np.floor(low) - _MARGIN_POSTS, np.ceil(high) + _MARGIN_POSTS + 1.0)
        for low, high in zip(points_m.min(axis=0) / p.posting_m, points_m.max(axis=0) / p.posting_m, strict=True)
    )
    level = int(np.clip(np.rint(np.log2(p.posting_m / surface.spacing_m)), 0, len(surface.levels) - 1))
    ground = surface.height(*np.meshgrid(x, y, indexing="ij"), level)
    sigma = p.correlation_m / p.posting_m
    error = gaussian_filter(rng.standard_normal(ground.shape), sigma, mode="wrap")
    # Gaussian smoothing reduces the variance of white noise to the fraction 1 / (4 pi sigma**2)
    error *= p.error_m * np.sqrt(4.0 * np.pi) * sigma
    return RegularGridInterpolator((x, y), ground + error)


@dataclass(frozen=True)
class FieldRun:
    """A simulated and processed run.

    - flown: flight and clouds of the run
    - truth: true motion at the images of the passes
    - images: measurements at the images
    - attitudes: estimated attitudes at the images' time tags
    - triples: triples of the run, one per case
    """

    flown: FlownRun
    truth: Motion
    images: ImageMeasurements
    attitudes: Rotation
    triples: tuple[Triple, ...]


def simulate_run(key: RunKey) -> FieldRun:
    """Simulate and process a run; the result depends only on the key."""
    p, run, generator = key.field_test, key.parameters, key.generator
    ground = run_ground(key)
    surface = ground.surface
    # flight line with random position and azimuth; heights refer to the mean ground below it
    rng = generator("flight")
    centre, azimuth = rng.uniform(0.0, surface.period_m, 2), float(rng.uniform(0.0, 2.0 * np.pi))
    offsets = np.linspace(-0.5, 0.5, _GROUND_POINTS) * p.helicopter.length_m
    line_heights = surface.height(centre[0] + offsets * np.sin(azimuth), centre[1] + offsets * np.cos(azimuth))
    origin = np.array([*centre, float(line_heights.mean())])
    flight = draw_helicopter_flight(p.helicopter, origin, azimuth, site(run.site).environment.gravity_m_s2, rng)
    clouds = None
    if run.clouds is not None:
        clouds = CloudLayer.draw(run.clouds, generator("clouds"), ground_m=float(flight.origin_m[2]))
    flown = FlownRun(key, clouds, flight)
    interval = p.images.interval_s
    pass_times = [np.arange(leg.start_s + 0.5 * interval, leg.end_s, interval) for leg in flight.passes]
    times = np.concatenate(pass_times)
    pass_indices = np.repeat(np.arange(len(pass_times)), [times.size for times in pass_times])
    clock = Clock.draw(p.images.clock, generator("camera clock"))
    gps = Gps.draw(p.gps, flight.span_s, generator("gps"))
    tags = clock.tags(times, generator("image tags"))
    position = gps.measure(flight, tags, generator("gps noise"))
    solution = _estimate_attitudes(flown, ground, clock, gps)
    attitudes = solution.attitude(tags)
    horizontal = np.ascontiguousarray(position[:, :2])
    elevation_model = simulate_elevation_model(p.elevation, surface, horizontal, generator("elevation model"))
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
    return FieldRun(
        flown=flown,
        truth=flight.motion(times),
        images=images,
        attitudes=attitudes,
        triples=draw_triples(run, images, p.triples, generator("triples")),
    )


def _estimate_attitudes(run: FlownRun, ground: SiteGround, clock: Clock, gps: Gps) -> InertialSolution:
    """Simulate both passes over the targets and the gyros, and estimate the attitude over the flight."""
    p, flight, generator = run.key.field_test, run.flight, run.key.generator
    targets = Targets.draw(p.targets, ground.surface, flight.origin_m[:2], generator("targets"))
    camera, noise, sightings = run.key.calibrated_camera(), generator("sightings"), []
    for start, end in flight.fly_overs_s:
        times = np.linspace(start, end, p.targets.images + 2)[1:-1]
        tags = clock.tags(times, noise)
        fixes = gps.measure(flight, tags, noise)
        if p.targets.sightings == "rendered":
            centroids = render_and_detect_targets(run, ground, targets, times, fixes)
        else:
            true_camera = p.detector.delivered_camera(field_camera())
            centroids = project_targets(targets, true_camera, flight.motion(times), p.targets.centroid_px, noise)
        sightings.append(Sightings.from_centroids(targets, camera, tags, fixes, centroids))
        if (count := len(sightings[-1].times_s)) < _MIN_SIGHTINGS:
            raise ValueError(
                f"{run.parameters.name}: {count} sightings of targets in a pass; the attitude needs {_MIN_SIGHTINGS}"
            )
    first, second = sightings
    earth = EarthRotation.at_latitude(run.parameters.latitude_deg)
    imu = Imu.draw(p.imu, flight.span_s, generator("imu errors"))
    increments = imu.increments(InertialTrajectory(flight, earth), *flight.span_s, generator("imu noise"))
    increments = add_thermal_drift(increments, p.drift, flight, flight.span_s[0])
    # standard deviation of a direction: the larger of the centroid's error and the remaining GPS error, as angles
    pixel_rad = 1.0 / camera.focal_lengths[0]
    sighting_sd_rad = max(p.targets.centroid_px * pixel_rad, p.gps.horizontal_wander_m / p.helicopter.fly_over_m)
    return solve_attitude(increments, first, second, sighting_sd_rad, p.imu.gyro_bias_deg_h * DEG_H, earth)


def render_and_detect_targets(
    run: FlownRun,
    ground: SiteGround,
    targets: Targets,
    times_s: Float64[np.ndarray, "images"],
    gps_m: Float64[np.ndarray, "images 3"],
) -> list[Float64[np.ndarray, "targets 2"]]:
    """Render the images of a pass over the targets and detect the targets in them; see `detect_targets`."""
    p, key = run.key.field_test, run.key
    scene = build_start_scene(run, ground, p.helicopter.fly_over_m)
    objects = Objects.join([scene.objects, targets.panels(p.targets.albedo)])
    # more rays at edges than for rocks, because a side of a target is 2 pixels; at the targets, mesh lines are at most
    # one terrain sample apart, because coarser ground would hide some of the targets
    scene = replace(
        scene, objects=objects, edge_rays=_TARGET_EDGE_RAYS, mesh_finest_m=_MESH_SAMPLES * ground.surface.spacing_m
    )
    camera, detector, noise = key.calibrated_camera(), key.detector(), key.generator(f"targets at {times_s[0]:.0f} s")
    prior_error = np.radians(p.targets.prior_deg) * key.generator("platform alignment").standard_normal(3)
    prior = Rotation.from_rotvec(prior_error) * Rotation.from_euler("z", 0.5 * np.pi - run.flight.azimuth_rad)
    centroids = []
    for time, position in zip(times_s.tolist(), gps_m, strict=True):
        image, _ = take_image(run, scene, ground, run.flight.state(time), detector, noise)
        centroids.append(detect_targets(image, targets, camera, position, prior, np.radians(p.targets.prior_deg)))
    return centroids
