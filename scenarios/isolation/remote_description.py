"""Description of a custom algorithm, as the worker receives it from a process of its own."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.serving import acquire_server
from marsyard.algorithms.faults import AlgorithmError
from marsyard.scenarios.isolation.remote import PythonCommand, absolute_spec, search_path


@dataclass(frozen=True)
class AlgorithmDescription:
    """Description of the class or function that creates a custom algorithm.

    - kind: name of its type
    - members: names of its public members
    - version, options: its attributes of these names, for the record of a campaign
    """

    kind: str
    is_class: bool
    is_callable: bool
    members: frozenset[str]
    version: str | None
    options: Mapping[str, Any]


@cache
def describe_in_process(spec: str) -> AlgorithmDescription:
    """Import a custom algorithm in a process of its own, and describe it. Raises ImportError with the reason."""
    spec = absolute_spec(spec)
    command, limits = PythonCommand(spec=spec), ExecutableLimits()
    try:
        server = acquire_server(command, limits)
        request = {"do": "describe", "path": search_path(), "spec": spec}
        answer, _ = server.send_request(request, limits.loading_s)
    except AlgorithmError as error:
        raise ImportError(f"{error.fault.name}: {error}") from error
    server.child.stop()
    if "error" in answer or "fault" in answer:
        raise ImportError(str(answer.get("error", answer.get("message"))))
    contents = {key: value for key, value in answer.items() if key != "exchange"}
    return AlgorithmDescription(**{**contents, "members": frozenset(contents["members"])})
