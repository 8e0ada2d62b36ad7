"""A fast scenario for tests of error budgets: its error has known contributions of gyro and radar."""

import math
import time
from typing import Annotated

from pydantic import BaseModel, ConfigDict

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.error_sources import ErrorSource
from marsyard.sim.streams import Streams
from tests.campaigns.fake_scenario import ScenarioWithoutInputs

CAMPAIGN = """
name = "error-model"
scenario = "tests.campaigns.studies.error_model:ErrorModelScenario"
cases = 100
seed = 6

[dispersions]
load = { distribution = "normal", mean = 0.0, sd = 1.0 }
unused = { distribution = "normal", mean = 0.0, sd = 1.0 }
drift = { distribution = "uniform", low = 0.0, high = 2.0 }

[[requirements]]
id = "ERROR"
metric = "miss"
bound = 30.0
probability = 0.99
confidence = 0.9

[[requirements]]
id = "FLAG"
metric = "is_small"
probability = 0.99
confidence = 0.9

[[requirements]]
id = "MARGIN"
metric = "is_small"
margin = "error_margin"
probability = 0.99
confidence = 0.9
"""


GYRO, RADAR, FAN = (
    ErrorSource(name, title) for name, title in (("gyro", "gyroscope"), ("radar", "radar"), ("fan", "fan"))
)


class ErrorModelParameters(BaseModel):
    """Parameters of `ErrorModelScenario`; all errors have the same unit.

    - load: dispersed error that belongs to no error source
    - unused: dispersed parameter without an effect
    - gyro_sd, radar_sd: standard deviations of the errors of gyroscope and radar
    - floor_sd: standard deviation of an error that belongs to no error source
    - drift: factor of the radar's error
    - interaction: factor of the product of the gyroscope's and the radar's errors
    - fan: parameter of an error source without an effect; False switches the source off
    - sleep_s: duration of a case
    - refused_fraction: fraction of cases without an answer; a negative value makes each case fail
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    load: float = 0.0
    unused: float = 0.0
    gyro_sd: Annotated[float, GYRO] = 3.0
    radar_sd: Annotated[float, RADAR] = 2.0
    drift: Annotated[float, RADAR] = 1.0
    interaction: float = 0.0
    floor_sd: float = 1.0
    fan: Annotated[bool, FAN] = False
    sleep_s: float = 0.0
    refused_fraction: float = 0.0


class ErrorModelScenario(ScenarioWithoutInputs):
    """The error of a case is the column `miss`.

    It is ``load + floor_sd f + e_g + e_r + interaction e_g e_r`` with ``e_g = gyro_sd g`` and
    ``e_r = radar_sd r drift``, where f, g and r are standard normal numbers of separate random streams. The mean square
    of the uniform drift is 4/3.
    """

    name = "error-model"
    parameters_type = ErrorModelParameters

    def run(self, parameters: ErrorModelParameters, streams: Streams) -> CaseResult:
        p = parameters
        time.sleep(p.sleep_s)
        floor, gyro, radar = (float(streams.generator(name).standard_normal()) for name in ("floor", "gyro", "radar"))
        gyro_error, radar_error = p.gyro_sd * gyro, p.radar_sd * radar * p.drift
        error = p.load + p.floor_sd * floor + gyro_error + radar_error + p.interaction * gyro_error * radar_error
        math.sqrt(p.refused_fraction)  # raises ValueError for a negative fraction, so that the case fails
        answered = bool(streams.generator("refusal").random() >= p.refused_fraction)
        error = error if answered else math.nan
        row = {"miss": error, "is_small": error <= 30.0, "error_margin": 30.0 - error}
        return CaseResult("VALID" if answered else "REFUSED", answered, row, {})
