"""A fast scenario with a known probability of a violation: the load is normal, and its limit is a quantile."""

import math
import time

from pydantic import BaseModel, ConfigDict

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams
from tests.campaigns.fake_scenario import ScenarioWithoutInputs

CAMPAIGN = """
name = "limit-state"
scenario = "tests.campaigns.studies.limit_state:LimitStateScenario"
cases = 100
seed = 3

[dispersions]
"loads.0" = { distribution = "normal", mean = 0.0, sd = 1.0 }
"loads.1" = { distribution = "normal", mean = 0.0, sd = 1.0 }
kind = { distribution = "choice", values = ["plain", "rough"] }

[[requirements]]
id = "LOAD"
metric = "load"
bound = 100.0
probability = 0.99
confidence = 0.9

[[requirements]]
id = "FLAG"
metric = "is_safe"
probability = 0.99
confidence = 0.9

[[requirements]]
id = "MARGIN"
metric = "is_safe"
margin = "safety_margin"
probability = 0.99
confidence = 0.9
"""


class LimitStateParameters(BaseModel):
    """The load is ``100 + u - beta`` with the standard normal number u; its bound is 100.

    ``u = sqrt(1 - noise**2) (loads[0] + loads[1]) / sqrt(2) + noise n``, with a standard normal random number n.
    `kind` has no effect. `terrain` is the number of a terrain. With `step`, all margins are 1, except those of loads[1]
    above 6, which are violations: their probability is 1e-9.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    loads: tuple[float, float] = (0.0, 0.0)
    kind: str = "plain"
    noise: float = 0.0
    beta: float = 3.0
    sleep_s: float = 0.0
    terrain: int = -1
    step: bool = False


class LimitStateScenario(ScenarioWithoutInputs):
    """A violation of LOAD has the probability Phi(-beta) for any `noise`; Phi is the standard normal distribution."""

    name = "limit-state"
    parameters_type = LimitStateParameters

    def run(self, parameters: LimitStateParameters, streams: Streams) -> CaseResult:
        time.sleep(parameters.sleep_s)
        noise = float(streams.generator("noise").standard_normal())
        u = math.sqrt(1.0 - parameters.noise**2) * sum(parameters.loads) / math.sqrt(2.0) + parameters.noise * noise
        margin = parameters.beta - u
        if parameters.step:
            margin = -1.0 if parameters.loads[1] > 6.0 else 1.0
        row = {"load": 100.0 - margin, "is_safe": margin >= 0.0, "safety_margin": margin, "noise": noise}
        if parameters.terrain >= 0:
            row["terrain"] = parameters.terrain
        return CaseResult("VALID", True, row, {})
