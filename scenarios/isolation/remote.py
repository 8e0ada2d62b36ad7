"""Custom Python algorithms in processes of their own, as seen by the worker that sends them measurements.

The process is started once per worker, constructs the algorithm once, and receives one case after another. It ends
after an exception, an exceeded limit or an unreadable answer; the next case starts a new one.
"""

import os
import sys
import time
import weakref
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

from marsyard.algorithms.exchange.forms import read_member
from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.process import RunningProgram, temporary_folder
from marsyard.algorithms.exchange.serving import Command, acquire_server, release_server
from marsyard.algorithms.faults import AlgorithmError, Fault, bad_answer
from marsyard.algorithms.processes import children, processor_time_s
from marsyard.algorithms.worker_device import worker_device
from marsyard.scenarios.imports import source_root
from marsyard.scenarios.isolation.plain import decode
from marsyard.scenarios.isolation.transport import Sender
from marsyard.scenarios.stored_objects import SUFFIX

#: Maximum characters of the traceback of an algorithm.
_MAX_TRACE = 8000


class PythonProgram(RunningProgram):
    """Process of a custom Python algorithm, with the descriptor of its shared memory (`memory_fd`)."""

    def __init__(self, spec: str, limits: ExecutableLimits) -> None:
        self.memory_fd = os.memfd_create("measurements")
        weakref.finalize(self, os.close, self.memory_fd)
        words = (sys.executable, "-P", "-m", "marsyard.scenarios.isolation.host", str(self.memory_fd))
        folder = temporary_folder()
        super().__init__(
            words, limits, folder, working_folder=folder, readable=source_root(spec), descriptors=(self.memory_fd,)
        )

    @property
    def max_greeting_s(self) -> float:
        """Limit of the time to import and construct the class."""
        return self.limits.loading_s

    def find_algorithm(self) -> int:
        """Return the process id of the algorithm, the last descendant, before it executes code of the user."""
        process = self.process_id
        while found := children(process):
            process = found[0]
        return process


@dataclass(frozen=True)
class PythonCommand(Command):
    """Command of the process of a custom Python algorithm; `spec` is its ``module:name`` or ``FILE.pkl:name``."""

    words: tuple[str, ...] = ()
    persistent: bool = True
    spec: str = ""

    def start(self, limits: ExecutableLimits) -> RunningProgram:
        """See `Command`."""
        return PythonProgram(self.spec, limits)


class RemoteAlgorithm:
    """A custom algorithm in a process of its own; it has the public members of the algorithm.

    Methods and attributes raise AlgorithmError if the algorithm fails. Answers consist of the classes of its protocol.
    """

    def __init__(self, spec: str, limits: ExecutableLimits, classes: Mapping[str, type]) -> None:
        """Start a case: construct the algorithm in its process, or reset it there; `algorithm_time_s` excludes this."""
        start_s, spec = time.process_time(), absolute_spec(spec)
        command = PythonCommand(spec=spec)
        self._classes = classes
        self._server = acquire_server(command, limits)
        self._release = weakref.finalize(self, release_server, command, limits, self._server)
        child = cast(PythonProgram, self._server.child)
        self._sender = Sender(child.memory_fd)
        self._process = child.find_algorithm()
        start = {"path": search_path(), "spec": spec, "device": worker_device(limits.devices)}
        answer = self._request("start", start, start_up_s=limits.loading_s)
        members = answer.get("members")
        self._members = members if isinstance(members, dict) else {}
        _Time.correction_s -= time.process_time() - start_s

    def __getattr__(self, name: str) -> Any:
        """Return a method of the algorithm, or the present value of an attribute."""
        members = self.__dict__.get("_members", {})
        if name not in members:
            raise AttributeError(f"the algorithm has no member {name}")
        if members[name]:
            return partial(self._call, name)
        return decode(self._request("get", {"member": name}).get("value"), self._classes)

    def __dir__(self) -> list[str]:
        """Return the names of the public members of the algorithm."""
        return sorted(self._members)

    def _call(self, method: str, *arguments: Any) -> Any:
        """Call a method; its processor time replaces that of the exchange in `algorithm_time_s`."""
        start_s, start_remote_s = time.process_time(), self._processor_time_s()
        layout = self._sender.send(arguments)
        answer = self._request("call", {"member": method, **asdict(layout)})
        _Time.correction_s += max(self._processor_time_s() - start_remote_s, 0.0)
        value = decode(answer.get("value"), self._classes)
        _Time.correction_s -= time.process_time() - start_s
        return value

    def _processor_time_s(self) -> float:
        try:
            return processor_time_s(self._process)
        except OSError:  # the process has ended, which the next request reports; its time is lost
            return 0.0

    def _request(self, action: str, values: Mapping[str, Any], start_up_s: float | None = None) -> Mapping[str, Any]:
        try:
            answer, output = self._server.send_request({"do": action, **values}, start_up_s)
            if "fault" in answer:
                self._server.child.stop()
                raise _read_fault(answer, output.stderr)
        except AlgorithmError:
            # the process has ended: do not return it to the idle processes
            self._release.detach()
            raise
        return answer


def _read_fault(answer: Mapping[str, Any], stderr: str) -> AlgorithmError:
    """Create the error of an algorithm that raised an exception."""
    message, trace = (answer.get(key) for key in ("message", "trace"))
    if not isinstance(message, str) or not isinstance(trace, str):
        return bad_answer("its process answered without a message")
    return AlgorithmError(read_member("fault", answer.get("fault"), Fault), message, stderr, trace[-_MAX_TRACE:])


def is_remote(algorithm: object) -> bool:
    """Whether an algorithm, or the stream of a `StreamedEstimator`, runs in a process of its own."""
    return isinstance(algorithm, RemoteAlgorithm) or isinstance(getattr(algorithm, "stream", None), RemoteAlgorithm)


class _Time:
    """Processor time of algorithms in processes of their own, minus the time of this process for the exchange, s."""

    correction_s = 0.0


def algorithm_time_s() -> float:
    """Return the processor time of this process and of the algorithms that it called, without exchanging data, s."""
    return time.process_time() + _Time.correction_s


def absolute_spec(spec: str) -> str:
    """Return the name of a stored object with its absolute path, and any other name unchanged."""
    file, _, name = spec.rpartition(":")
    return f"{Path(file).absolute()}:{name}" if file.endswith(SUFFIX) else spec


def search_path() -> list[str]:
    """Return the folders in which this process finds modules; the current folder is the last."""
    return [*(folder for folder in sys.path if folder), str(Path.cwd())]


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
        answer, _ = server.send_request(request, start_up_s=limits.loading_s)
    except AlgorithmError as error:
        raise ImportError(f"{error.fault.name}: {error}") from error
    server.child.stop()
    if "error" in answer or "fault" in answer:
        raise ImportError(str(answer.get("error", answer.get("message"))))
    contents = {key: value for key, value in answer.items() if key != "exchange"}
    return AlgorithmDescription(**{**contents, "members": frozenset(contents["members"])})
