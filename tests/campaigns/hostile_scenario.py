"""A scenario whose cases each do something to their worker or their row that they must not."""

from __future__ import annotations

import os
from typing import Any

from pydantic import BaseModel, ConfigDict

from marsyard.scenarios.interface import CaseResult, record_conditions
from marsyard.sim.streams import Streams

#: What each case does, by its number.
DEEDS = (
    "nothing",
    "text in a metric",
    "text in a population",
    "int of 400 digits",
    "int of 5000 digits",
    "closes files",
    "closes output",
    "error without a message",
    "surrogates",
    "raises",
    "exits",
    "list in a column",
)


class HostileParameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SilentError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no message")


class HostileScenario:
    name = "hostile"
    parameters_type = HostileParameters

    def shared_inputs(self, parameters: BaseModel) -> tuple[int, ...]:
        return ()

    def prepare(self, parameters: BaseModel, shared_input: int) -> None:
        """Nothing."""

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        deed = DEEDS[streams.case % len(DEEDS)]
        conditions = {"near": streams.case < 2 * len(DEEDS), "height_m": 10.0 + streams.case}
        record_conditions(conditions)
        row: dict[str, Any] = {"velocity_error_m_s": 1.0, "met": True, "number": 1, "text": "a", **conditions}
        outcome = "VALID"
        if deed == "text in a metric":
            row["velocity_error_m_s"] = "small"
        elif deed == "text in a population":
            row["near"] = "yes"
        elif deed == "int of 400 digits":
            row["number"] = 10**400
        elif deed == "int of 5000 digits":
            row["velocity_error_m_s"] = 10**5000
        elif deed == "closes files":
            os.closerange(3, 256)
        elif deed == "closes output":
            os.close(1)
        elif deed == "error without a message":
            raise SilentError
        elif deed == "surrogates":
            outcome, row["text \udc80"] = "VALID \udc80", "\udc80"
        elif deed == "raises":
            raise ValueError("the algorithm raised")
        elif deed == "exits":
            os._exit(3)
        elif deed == "list in a column":
            row["text"] = ["a"]
        return CaseResult(outcome, True, row)
