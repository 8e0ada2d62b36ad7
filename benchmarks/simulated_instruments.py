"""Errors of the simulated instruments of a descent campaign, without images.

`benchmarks.dimes_threshold` uses them as inputs of the derivation of DIMES' threshold.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from marsyard.campaigns.definition.campaign import Campaign
from marsyard.scenarios.descent.conditions import instrument_errors
from marsyard.scenarios.descent.flight import create_flight, states_at_images
from marsyard.scenarios.descent.images import camera_optics
from marsyard.scenarios.descent.measurements import DescentInstruments, measure
from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.simulation import draw_detector
from marsyard.scenarios.descent.world import DescentWorld
from marsyard.scenarios.interface import Scalar


@dataclass(frozen=True)
class InstrumentErrors:
    """Standard deviations of measurement errors, per axis for attitudes and velocities.

    - common_altitude_sd, altitude_sd: Relative errors of altitude, common to all images and independent
    - common_attitude_sd_deg, attitude_sd_deg: Errors of attitude, common and independent; they include the errors of
      the time tags
    - imu_sd_m_s: Errors of the horizontal velocity change between the image pairs
    """

    common_altitude_sd: float
    altitude_sd: float
    common_attitude_sd_deg: float
    attitude_sd_deg: float
    imu_sd_m_s: float


def simulate_instruments(campaign: Campaign, cases: int) -> InstrumentErrors:
    """Simulate the instruments of the first cases of a descent campaign with three images."""
    rows = [_simulate_case(campaign, case) for case in range(cases)]

    def rms(column: str) -> float:
        return float(np.sqrt(np.mean([float(row[column]) ** 2 for row in rows])))

    # the columns have residuals from the mean of three images: the variance is 3 / 2 of their mean square
    unbiased = np.sqrt(1.5)
    # the columns of attitude are lengths of vectors with three axes, that of velocity with two
    return InstrumentErrors(
        common_altitude_sd=rms("altitude_error_common"),
        altitude_sd=float(unbiased * rms("altitude_error_independent")),
        common_attitude_sd_deg=rms("attitude_error_common_deg") / float(np.sqrt(3.0)),
        attitude_sd_deg=float(unbiased * rms("attitude_error_independent_deg") / np.sqrt(3.0)),
        imu_sd_m_s=rms("velocity_change_error_m_s") / float(np.sqrt(2.0)),
    )


def _simulate_case(campaign: Campaign, case: int) -> Mapping[str, Scalar]:
    """Simulate the measurements of a case with empty images; return the columns of their errors."""
    p, streams = campaign.parameters(case), campaign.streams(case)
    assert isinstance(p, DescentScenarioParameters)
    world = DescentWorld.from_parameters(p)
    flight = create_flight(p, world.surface, streams)
    states = states_at_images(p, flight)
    detector = draw_detector(p, camera_optics(p.camera), streams)
    instruments = DescentInstruments.draw(p, world, flight, streams)
    images = [np.zeros((1, 1), dtype=np.uint16)] * len(states)
    measurements = measure(p, world, flight.motion, images, detector, instruments, streams)
    return instrument_errors(p, world, states, measurements)
