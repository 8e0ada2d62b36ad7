"""Tests of the geometric accuracy of DIMES without noise and with ideal instruments."""

from typing import Any

import numpy as np
import pytest

from marsyard.algorithms.dimes import DimesDetails, DimesEstimator, DimesTrack
from marsyard.algorithms.dimes.views import altitudes_at_images
from marsyard.scenarios.descent.flight import create_flight, mean_velocities, states_at_images
from marsyard.scenarios.descent.images import camera_optics, take_exposures
from marsyard.scenarios.descent.measurements import DescentInstruments, measure
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.sim.dynamics import State
from marsyard.sim.measurements import DescentMeasurements
from marsyard.sim.sensor import Detector
from marsyard.sim.streams import Streams
from marsyard.sim.terrain import Surface
from tests.scenarios.descent.descents import FLAT_TERRAIN, IDEAL_INSTRUMENTS, NOISELESS_DETECTOR, make_parameters

#: Rough ground on a long wave of the terrain ("swell") with 200 m between trough and crest.
RELIEF = {"samples": 1024, "spacing_m": 4.0, "rms_slope_deg": 1.0, "swell": {"relief_m": 200.0}}
N_CASES = 5


def _run_descent(case: int, **tables: Any) -> tuple[list[DimesTrack], list[State], DescentMeasurements, Surface]:
    """Run a descent with the full dispersion of motions and return the tracks that passed DIMES' checks."""
    rng = np.random.default_rng(case)
    motion = {
        "wind_east_m_s": rng.uniform(-21.0, 21.0),
        "wind_north_m_s": rng.uniform(-21.0, 21.0),
        "cone_angle_deg": rng.uniform(0.0, 15.0),
        "cone_phase_deg": rng.uniform(0.0, 360.0),
        "nod_rate_deg_s": rng.uniform(0.0, 60.0),
        "nod_phase_deg": rng.uniform(0.0, 360.0),
        "heading_deg": rng.uniform(0.0, 360.0),
    }
    parameters = make_parameters(**IDEAL_INSTRUMENTS, descent=motion, detector=NOISELESS_DETECTOR, **tables)
    world, streams = DescentWorld.from_parameters(parameters), Streams(5, "accuracy", case)
    flight = create_flight(parameters, world.surface, streams)
    states = states_at_images(parameters, flight)
    optics = camera_optics(parameters.camera)
    detector = Detector.draw(optics.fall_off, parameters.detector, streams.generator("detector response"))
    images = [counts for counts, _ in take_exposures(parameters, world, states, optics, detector, streams)]
    instruments = DescentInstruments.draw(parameters, world, flight, streams)
    measurements = measure(parameters, world, flight.motion, images, detector, instruments, streams)
    details = DimesEstimator().estimate(measurements).details
    assert isinstance(details, DimesDetails)
    return [track for track in details.tracks if track.valid], states, measurements, world.surface


def _compute_velocity_errors(tracks: list[DimesTrack], states: list[State]) -> np.ndarray:
    """Return estimated minus true horizontal velocity of each track, m/s, shape (n, 2)."""
    true_velocities = mean_velocities(states)[:, :2]
    return np.array([track.velocity_m_s - true_velocities[track.pair] for track in tracks]).reshape(-1, 2)


@pytest.mark.slow
def test_flat_ground_velocity_error_is_within_15_cm_s() -> None:
    """Requirement: 0.15 m/s rms over all valid tracks, including tracks of cases without a reported velocity."""
    runs = [_run_descent(case, terrain=FLAT_TERRAIN) for case in range(N_CASES)]
    errors = np.concatenate([_compute_velocity_errors(tracks, states) for tracks, states, _, _ in runs])
    assert len(errors) >= 3 * N_CASES
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.15


@pytest.mark.slow
def test_relief_errors_match_geometric_prediction() -> None:
    """Requirement: errors agree with the formula to 0.2 m/s rms over 200 m of relief.

    The estimator assumes a plane at the measured altitude H. A point at height h above the plane, with the assumed
    horizontal offset rho, has the true offset ``rho (1 - h / H)``. The error of a displacement is
    ``h1 rho1 / H1 - h2 rho2 / H2``. Correlation yields the mean over the heights in a template, weighted by the
    squared image gradients.
    """
    track_errors, track_predictions = [], []
    for case in range(N_CASES):
        tracks, states, measurements, surface = _run_descent(
            case, terrain=RELIEF, location={"bank": 1, "east_m": 511.0 * case}
        )
        track_errors.append(_compute_velocity_errors(tracks, states))
        track_predictions += [_predict(track, states, measurements, surface) for track in tracks]
    simulated_errors, predicted_errors = np.concatenate(track_errors), np.array(track_predictions)
    assert len(simulated_errors) >= 3 * N_CASES
    assert np.sqrt(np.mean(np.sum((simulated_errors - predicted_errors) ** 2, axis=1))) < 0.2
    # The relief causes significant errors.
    assert np.sqrt(np.mean(np.sum(simulated_errors**2, axis=1))) > 0.4


def _predict(track: DimesTrack, states: list[State], measurements: DescentMeasurements, surface: Surface) -> np.ndarray:
    """Return the predicted velocity error of a track, m/s; the test of relief errors defines the formula."""
    first, second = states[track.pair], states[track.pair + 1]
    altitude_1, altitude_2 = altitudes_at_images(measurements)[track.pair : track.pair + 2]
    template_size_px = len(track.template)
    # Binned pixels of 4 x 12 um, focal length 14.67 mm.
    pixel_size_m = altitude_2 * 4.0 * 12e-6 / 14.67e-3
    offsets_m = pixel_size_m * (np.arange(template_size_px) - 0.5 * (template_size_px - 1))
    # Rows increase southwards.
    offsets = np.stack([np.tile(offsets_m, template_size_px), np.repeat(-offsets_m, template_size_px)], axis=1)
    rho_1 = track.ground_m + offsets
    # Fixed-point iteration for the intersection of each viewing ray with the terrain: true offset / assumed offset.
    true_fraction = np.ones(len(rho_1))
    for _ in range(60):
        positions = first.position_m[:2] + true_fraction[:, None] * rho_1
        true_fraction = (first.position_m[2] - surface.height(positions[:, 0], positions[:, 1])) / altitude_1
    heights = first.position_m[2] - true_fraction * altitude_1
    height_1 = heights - (first.position_m[2] - altitude_1)
    height_2 = heights - (second.position_m[2] - altitude_2)
    true_offset = first.position_m[:2] + true_fraction[:, None] * rho_1 - second.position_m[:2]
    rho_2 = true_offset / (1.0 - height_2 / altitude_2)[:, None]
    shifts = height_1[:, None] * rho_1 / altitude_1 - height_2[:, None] * rho_2 / altitude_2
    gradient_south, gradient_east = np.gradient(track.template)
    gradients = np.stack([gradient_east.ravel(), -gradient_south.ravel()], axis=1)
    weights = gradients[:, :, None] * gradients[:, None, :]
    mean_shift = np.linalg.solve(weights.sum(axis=0), np.einsum("nij,nj->i", weights, shifts))
    return np.asarray(mean_shift / (second.time_s - first.time_s))
