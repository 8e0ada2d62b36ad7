"""A scenario for the tests of isolation: cases damage their worker process or return invalid rows."""

import os
from typing import Any

from pydantic import BaseModel, ConfigDict

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams
from tests.campaigns.fake_scenario import ScenarioWithoutInputs

#: Case n has the fault with index n modulo the number of faults.
FAULTS = (
    "no fault",
    "text in a metric",
    "text in a population",
    "int of 400 digits",
    "int of 5000 digits",
    "closes files",
    "closes standard output",
    "error without a message",
    "surrogate characters",
    "raises",
    "exits",
    "list in a column",
)


class HostileParameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    height_m: float = 0.0


class SilentError(Exception):
    """An exception whose message cannot be formatted."""

    def __str__(self) -> str:
        raise RuntimeError("no message")


class HostileScenario(ScenarioWithoutInputs):
    name = "hostile"
    parameters_type = HostileParameters

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        fault = FAULTS[streams.case % len(FAULTS)]
        row: dict[str, Any] = {"velocity_error_m_s": 1.0, "met": True, "number": 1, "text": "a", "is_low": True}
        outcome = "VALID"
        if fault == "text in a metric":
            row["velocity_error_m_s"] = "small"
        elif fault == "text in a population":
            row["is_low"] = "yes"
        elif fault == "int of 400 digits":
            row["number"] = 10**400
        elif fault == "int of 5000 digits":
            row["velocity_error_m_s"] = 10**5000
        elif fault == "closes files":
            os.closerange(3, 256)
        elif fault == "closes standard output":
            os.close(1)
        elif fault == "error without a message":
            raise SilentError
        elif fault == "surrogate characters":
            outcome, row["text \udc80"] = "VALID \udc80", "\udc80"
        elif fault == "raises":
            raise ValueError("the algorithm raised")
        elif fault == "exits":
            os._exit(3)
        elif fault == "list in a column":
            row["text"] = ["a"]
        return CaseResult(outcome, True, row)
