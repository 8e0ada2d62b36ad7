"""A fast scenario of an estimator with a planted defect: it fails only with a low sun and a yaw near 90 deg."""

from pydantic import BaseModel, ConfigDict

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams
from tests.campaigns.fake_scenario import ScenarioWithoutInputs

CAMPAIGN = """
name = "planted-defect"
scenario = "tests.campaigns.studies.planted_defect:PlantedDefectScenario"
cases = 100
seed = 1

[parameters]
sun_deg = 45.0

[dispersions]
sun_deg = { distribution = "uniform", low = 10.0, high = 60.0 }
yaw_deg = { distribution = "uniform", low = 0.0, high = 360.0 }
altitude_m = { distribution = "normal", mean = 1500.0, sd = 100.0 }
wind_m_s = { distribution = "normal", mean = 0.0, sd = 5.0 }
dust = { distribution = "uniform", low = 0.3, high = 1.2 }
slope_deg = { distribution = "uniform", low = 0.0, high = 10.0 }
terrain = { distribution = "integer", low = 0, high = 249 }
blur_px = { distribution = "uniform", low = 0.0, high = 1.0 }

[[requirements]]
id = "VELOCITY"
statement = "The error is at most 5 m/s."
metric = "velocity_error_m_s"
bound = 5.0
probability = 0.99
confidence = 0.9
population = "valid"
"""


class PlantedDefectParameters(BaseModel):
    """Parameters of the scenario; only `sun_deg` and `yaw_deg` cause the defect."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sun_deg: float = 45.0
    yaw_deg: float = 0.0
    altitude_m: float = 1500.0
    wind_m_s: float = 0.0
    dust: float = 0.5
    slope_deg: float = 2.0
    terrain: int = 0
    blur_px: float = 0.3


class PlantedDefectScenario(ScenarioWithoutInputs):
    """Errors above 5 m/s occur only if the sun is below 15 deg and the yaw is within 10 deg of 90 deg.

    The error increases towards this region.
    """

    name = "planted-defect"
    parameters_type = PlantedDefectParameters

    def run(self, parameters: PlantedDefectParameters, streams: Streams) -> CaseResult:
        noise = abs(float(streams.generator("noise").normal(scale=0.5)))
        # scaled distances from the region of the defect; the error is only noise if one of them is at least 1
        sun_distance = max(parameters.sun_deg - 15.0, 0.0) / 15.0
        yaw_distance = max(abs(parameters.yaw_deg - 90.0) - 10.0, 0.0) / 60.0
        nearness = max(1.0 - sun_distance, 0.0) * max(1.0 - yaw_distance, 0.0)
        error = 8.0 + noise if nearness == 1.0 else min(3.5 * nearness + noise, 4.9)
        return CaseResult("VALID", True, {"velocity_error_m_s": error, "sun_deg": parameters.sun_deg}, {})
