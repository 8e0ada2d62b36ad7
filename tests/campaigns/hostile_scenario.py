"""A scenario for the tests of isolation: cases damage their worker process or return invalid rows."""

import os
from collections.abc import Callable
from typing import Any

from pydantic import BaseModel, ConfigDict

from marsyard.scenarios.interface import CaseResult
from marsyard.sim.streams import Streams
from tests.campaigns.fake_scenario import ScenarioWithoutInputs


class SilentError(Exception):
    """An exception whose message cannot be formatted."""

    def __str__(self) -> str:
        raise RuntimeError("no message")


def _raise(error: Exception) -> None:
    raise error


#: Faults: change of the row or of the process, and the recorded error, which is empty if the row is valid. Case n has
#: the fault with index n modulo the number of faults.
FAULTS: list[tuple[Callable[[dict[str, Any]], object], str]] = [
    (lambda row: None, ""),
    (lambda row: row.update(velocity_error_m_s="small"), "contains 'small'; error needs a number"),
    (lambda row: row.update(is_low="yes"), "column is_low contains 'yes'; error needs true or false"),
    (lambda row: row.update(number=10**400), "column number contains an integer of 1329 bits"),
    (lambda row: row.update(velocity_error_m_s=10**5000), "velocity_error_m_s contains an integer of 16610 bits"),
    (lambda row: os.closerange(3, 256), "the case closed or replaced the worker's file descriptors"),
    (lambda row: os.close(1), ""),
    (lambda row: _raise(SilentError()), "SilentError (its message cannot be formatted)"),
    (lambda row: row.update({"outcome": "VALID \udc80", "text \udc80": "\udc80"}), ""),
    (lambda row: _raise(ValueError("the algorithm raised")), "ValueError: the algorithm raised"),
    (lambda row: os._exit(3), "the worker process died: EXIT (3)"),
    (lambda row: row.update(text=["a"]), "column text contains a list"),
]


class HostileParameters(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    height_m: float = 0.0


class HostileScenario(ScenarioWithoutInputs):
    name = "hostile"
    parameters_type = HostileParameters

    def run(self, parameters: BaseModel, streams: Streams) -> CaseResult:
        row: dict[str, Any] = {"velocity_error_m_s": 1.0, "met": True, "number": 1, "text": "a", "is_low": True}
        row["outcome"] = "VALID"
        FAULTS[streams.case % len(FAULTS)][0](row)
        return CaseResult(row.pop("outcome"), True, row)
