"""Parameters of the descent tests: a small terrain, one descent, ideal instruments and a noiseless detector."""

from collections.abc import Mapping
from typing import Any

from marsyard.scenarios.descent.parameters import DescentScenarioParameters
from marsyard.scenarios.descent.scenario import DescentScenario
from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams

#: A small terrain (3 km) that is generated quickly.
SMALL_WORLD: dict[str, Any] = {"terrain": {"samples": 1024, "spacing_m": 3.0}, "location": {"bank": 1}}
#: The same terrain without relief.
FLAT_TERRAIN = {"samples": 1024, "spacing_m": 3.0, "rms_slope_deg": 0.0, "craters_per_km2": 0.0}
#: A descent with wind drift, swing and rotation.
DESCENT = {
    "wind_east_m_s": 14.0,
    "wind_north_m_s": -9.0,
    "gust_intensity_m_s": 0.5,
    "cone_angle_deg": 12.0,
    "nod_rate_deg_s": 30.0,
    "heading_deg": 70.0,
}
_IDEAL_CLOCK = {"offset_sd_s": 0.0, "jitter_sd_s": 0.0}
#: Instruments without errors.
IDEAL_INSTRUMENTS: Mapping[str, Mapping[str, Any]] = {
    "camera": {"alignment_error_deg": 0.0, "focal_error": 0.0, "centre_error_px": 0.0, "distortion_error_px": 0.0},
    "altimeter": {"scale_error": 0.0, "noise": 0.0, "count_m": 0.0, "clock": _IDEAL_CLOCK},
    "clock": _IDEAL_CLOCK,
    "approach": {"attitude_sd_deg": 0.0, "velocity_sd_m_s": 0.0, "spin_scale_ppm": 0.0},
    "imu": {
        "gyro_bias_deg_h": 0.0,
        "gyro_wander_deg_h": 0.0,
        "angular_random_walk_deg_sqrt_h": 0.0,
        "gyro_scale_ppm": 0.0,
        "gyro_misalignment_mrad": 0.0,
        "gyro_count_rad": 0.0,
        "accelerometer_bias_mg": 0.0,
        "accelerometer_wander_mg": 0.0,
        "velocity_random_walk_ug_sqrt_hz": 0.0,
        "accelerometer_scale_ppm": 0.0,
        "accelerometer_misalignment_mrad": 0.0,
        "accelerometer_count_m_s": 0.0,
        "clock": _IDEAL_CLOCK,
    },
}
#: A detector with negligible shot noise: response and full well are a million times those of the flight camera.
NOISELESS_DETECTOR = {
    "responsivity_e_s": 1.019e13,
    "full_well_e": 1.7e11,
    "gain_e_dn": 4.15e7,
    "response_spread": 0.0,
    "calibration_error": 0.0,
}


def make_parameters(**tables: Any) -> DescentScenarioParameters:
    """Return parameters of a descent over the small terrain; `tables` replaces tables and options of the scenario."""
    return DescentScenarioParameters.model_validate(SMALL_WORLD | {"descent": DESCENT} | tables)


def run_descent(case: int = 0, /, **tables: Any) -> CaseResult:
    """Run one descent over the small terrain; `tables` replaces tables and options of the scenario."""
    return DescentScenario().run(make_parameters(**tables), Streams(1, "test", case))
