"""Arrays and timeline of a landing case, for its figures in the report and the exports of `marsyard replay`."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.hda import HdaDetails, MappedGround, Safety, hda_products
from marsyard.algorithms.interface import SiteEstimate
from marsyard.scenarios.landing.flight import LandingFlight
from marsyard.scenarios.landing.helicopter import NavigatedLeg
from marsyard.scenarios.landing.score import true_site
from marsyard.scenarios.landing.simulation import RenderedFlight
from marsyard.scenarios.landing.touchdown import Touchdown
from marsyard.scenarios.meshes import add_meshes
from marsyard.scenarios.timeline import (
    CameraPose,
    InertialData,
    Path,
    Series,
    SurfacePatch,
    TimedImage,
    TimedPoints,
    Timeline,
)
from marsyard.scenarios.timeline_surface import surface_from_above
from marsyard.scenarios.views import Viewpoint, site_scene
from marsyard.sim.render import Scene
from marsyard.sim.sensor import height_above_ground

#: Time between the poses of a path, s.
_STEP_S = 0.1
#: Half width of the shown ground divided by the height of the first image.
_HALF_WIDTH_RATIO = 1.5
#: Colours of the landing map, RGB; as in the paper's figures.
_COLOURS = {Safety.SAFE: (60, 160, 70), Safety.UNKNOWN: (225, 200, 70), Safety.HAZARD: (200, 50, 45)}


def case_products(case: RenderedFlight, estimate: SiteEstimate) -> dict[str, Any]:
    """Return the arrays for the case's figures.

    The arrays are those of `marsyard.algorithms.hda.hda_products` (Figs. 1-5 and 7), and:

    - `image_1`, `image_2`: the images;
    - `true_rotation`, `true_translation`: true motion from the first to the second camera's frame;
    - `true_positions`, `true_slope`, `true_roughness`, `true_safe`, `true_covered`: sampling grid of the truth,
      world axes;
    - `true_heights`, `true_corner`, `true_spacing`: exact heights, world axes (row i at y = corner[1] + i spacing);
    - `camera_true`, `camera_estimated`: body poses at the first image (4 x 4), true and estimated on board;
    - `limits`: the algorithm's limits of slope (radians) and roughness (metres), and the lander's diameter;
    - `site_true`: true x, y of the reported site (see `site_row`).
    """
    p, flight, pair, truth = case.p, case.flight, case.pair, case.truth
    arrays: dict[str, Any] = {"image_1": pair.counts[0], "image_2": pair.counts[1]}
    if isinstance(estimate.details, HdaDetails):
        arrays |= hda_products(estimate.details)
    second_from_first = flight.true_motion(pair.cameras)
    arrays |= {
        "true_rotation": second_from_first.rotation.as_matrix(),
        "true_translation": np.array(second_from_first.translation),
        "true_positions": truth.positions,
        "true_slope": truth.footprints.slope_rad,
        "true_roughness": truth.footprints.roughness_m,
        "true_safe": truth.footprints.safe,
        "true_covered": truth.covered,
        "true_heights": truth.relief.heights_m,
        "true_corner": np.array([truth.relief.west_m, truth.relief.south_m]),
        "true_spacing": np.array([truth.relief.spacing_m]),
        "camera_true": flight.states[0].world_from_body.as_matrix(),
        "camera_estimated": flight.poses[0].world_from_body.as_matrix(),
        "limits": np.array([p.hda.max_slope_rad, p.hda.max_roughness_m, truth.limits.diameter_m]),
    }
    site = true_site(estimate, flight)
    return arrays if site is None else {**arrays, "site_true": site}


def landing_timeline(case: RenderedFlight, estimate: SiteEstimate, touchdown: Touchdown | None) -> Timeline:
    """Create the timeline of a landing: flight with both images, landing map, reported site and touchdown."""
    p, world, flight = case.p, case.world, case.flight
    first = flight.states[0].position_m
    details = estimate.details if isinstance(estimate.details, HdaDetails) else None

    def create_scene(east_m: float, north_m: float, height_m: float, pixel_rad: float) -> Scene:
        scene = site_scene(world.ground, Viewpoint(east_m, north_m, height_m, pixel_rad), world.sun)
        return add_meshes(scene, world.meshes, (east_m, north_m))

    height_m = float(height_above_ground(world.ground.surface, first[None])[0])
    centre = (float(first[0]), float(first[1]))
    surfaces = {"ground": surface_from_above(create_scene, centre, _HALF_WIDTH_RATIO * height_m, p.render.backend)}
    if details is not None and details.ground is not None:
        surfaces["map"] = _landing_map(details.ground, first)
    points = {}
    if estimate.site_world is not None:
        points["reported site"] = TimedPoints.permanent(estimate.site_world - flight.position_error_m)
    if touchdown is not None:
        points["touchdown"] = TimedPoints(np.array([touchdown.time_s]), touchdown.state.position_m[None])
    paths = _paths(flight, touchdown)
    true = paths["true"]
    heights = height_above_ground(world.ground.surface, true.positions_m)
    legs = _legs(flight, touchdown)
    return Timeline(
        surfaces=surfaces,
        paths=paths,
        images=_images(case, details),
        points=points,
        series={"height, m": Series(true.times_s, heights)},
        inertial=_inertial_data(legs) if legs else None,
    )


def _legs(flight: LandingFlight, touchdown: Touchdown | None) -> list[NavigatedLeg]:
    """Return the navigated legs of the flight; none if the parameters define the poses."""
    legs = [] if flight.transit is None else [flight.transit.navigation_leg]
    return legs if touchdown is None else [*legs, touchdown.navigation_leg]


def _inertial_data(legs: list[NavigatedLeg]) -> InertialData:
    """Return the measurements of the inertial unit over all legs."""
    parts = [InertialData.from_increments(leg.solution.increments) for leg in legs]
    return InertialData(
        np.concatenate([part.times_s for part in parts]),
        np.concatenate([part.rates_rad_s for part in parts]),
        np.concatenate([part.specific_forces_m_s2 for part in parts]),
    )


def _paths(flight: LandingFlight, touchdown: Touchdown | None) -> dict[str, Path]:
    """Return the true path and the path that the on-board filter estimates."""
    if flight.transit is None:
        states, poses = flight.states, flight.poses
        image_times_s = [state.time_s for state in states]
        return {
            "true": Path.from_poses(image_times_s, [state.world_from_body for state in states]),
            "estimated": Path.from_poses(image_times_s, [pose.world_from_body for pose in poses]),
        }
    path = flight.transit.flight.path if touchdown is None else touchdown.flight.path
    start_s, end_s = path.span_s
    end_s = end_s if touchdown is None else min(end_s, touchdown.time_s + 1.0)
    legs, times = _legs(flight, touchdown), np.arange(start_s, end_s, _STEP_S)
    # the filter's estimates are at the boundaries of the inertial unit
    stride = max(round(_STEP_S / legs[0].solution.increments.period_s), 1)
    boundaries = np.concatenate([leg.boundaries_s for leg in legs])[::stride]
    positions = np.concatenate([leg.solution.positions_m for leg in legs])[::stride]
    attitudes = Rotation.concatenate([leg.solution.attitudes for leg in legs])[::stride]
    shown = boundaries <= end_s
    return {
        "true": Path.from_motion(path.motion(times)),
        "estimated": Path(boundaries[shown], positions[shown], attitudes.as_quat()[shown]),
    }


def _images(case: RenderedFlight, details: HdaDetails | None) -> list[TimedImage]:
    """Return both images with the features in the first, and their tracks in the second."""
    images = []
    for number, (image, state) in enumerate(zip(case.pair.images, case.flight.states, strict=True)):
        marks = {}
        if details is not None and details.tracks is not None:
            tracks = details.tracks
            pixels = tracks.second if number else tracks.first
            marks = {"tracks": pixels[tracks.accepted], "rejected": pixels[~tracks.accepted]}
        pose = CameraPose.from_camera(image.camera, state.world_from_body)
        bits = case.p.detector.bits
        images.append(TimedImage("camera", state.time_s, image.counts, bits, pose, marks))
    return images


def _landing_map(ground: MappedGround, camera_m: np.ndarray) -> SurfacePatch:
    """Return the landing map in the world, relative to the true position of the first camera."""
    shape = ground.elevation.elevation_m.shape
    local = ground.elevation.positions(np.moveaxis(np.indices(shape).astype(np.float64), 0, -1))
    points = np.concatenate([local, ground.elevation.elevation_m[..., None]], axis=-1)
    world = camera_m + ground.world_from_surface.apply(points.reshape(-1, 3)).reshape(points.shape)
    colours = np.zeros((*shape, 3), dtype=np.uint8)
    for safety, colour in _COLOURS.items():
        colours[ground.hazards.safety == safety] = colour
    return SurfacePatch(world.astype(np.float32), colours)
