"""Process of a custom Python algorithm: it executes requests of a worker, one JSON line each (`python -m`).

The process is the child of a guardian, a process without work. An algorithm that ends its parent process ends the
guardian and thereby itself. The arguments of a call arrive pickled in shared memory; the answer is a line with a plain
representation (`plain`). Everything that the algorithm prints goes to standard error.
"""

import contextlib
import inspect
import json
import os
import random
import signal
import sys
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NoReturn

from marsyard.algorithms.faults import Fault, describe_error
from marsyard.algorithms.processes import adopt_orphans, descendants, end_with_parent, kill

#: Version of the request lines, see `marsyard.algorithms.exchange.files`.
VERSION = 3


def main(memory_fd: int) -> None:
    """Serve requests until standard input ends; `memory_fd` is the descriptor of the shared memory."""
    _become_guarded()
    # the algorithm and its child processes do not inherit the descriptors of the exchange
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    os.set_inheritable(memory_fd, False)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    host = Host(memory_fd)
    _write(answers, {"ready": True})
    for line in requests:
        request = json.loads(line)
        _write(answers, {"id": request["id"], **host.answer(request)})


def _write(file: Any, answer: Mapping[str, Any]) -> None:
    file.write(json.dumps({"exchange": VERSION, **answer}) + "\n")
    file.flush()


def _become_guarded() -> None:
    """Fork into the guardian, which does not return, and the process of the algorithm, which returns."""
    adopt_orphans()
    guardian = os.getpid()
    if child := os.fork():
        _guard(child)
    end_with_parent(guardian, signal.SIGKILL)


def _guard(child: int) -> NoReturn:
    """Wait for the end of the algorithm's process, kill the processes that it left, and end in the same way."""
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(3):
        os.dup2(null, descriptor)  # the worker sees the end of the streams when the child ends
    status = None
    while status is None:
        process, wait_status = os.waitpid(-1, 0)
        if process == child:
            status = os.waitstatus_to_exitcode(wait_status)
    with contextlib.suppress(ChildProcessError):
        while True:  # until this process has no children
            kill(descendants(os.getpid()))
            os.waitpid(-1, 0)
    if status >= 0:
        os._exit(status)
    if -status not in (signal.SIGKILL, signal.SIGSTOP):
        signal.signal(-status, signal.SIG_DFL)
    os.kill(os.getpid(), -status)
    os._exit(128 - status)


class Host:
    """The algorithm and its case: executes requests and creates answers."""

    def __init__(self, memory_fd: int) -> None:
        self._memory_fd = memory_fd
        self._factory: Any = None
        self._algorithm: Any = None
        self._receiver: Any = None
        self._is_seeded = False

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Execute a request; an exception of the algorithm becomes a fault in the answer."""
        actions: Mapping[str, Callable[..., dict[str, Any]]] = {
            "describe": self._describe,
            "start": self._start,
            "call": self._call,
            "get": self._get,
        }
        arguments = {key: value for key, value in request.items() if key not in ("exchange", "id", "do")}
        process = os.getpid()
        try:
            answer = actions[request["do"]](**arguments)
        except BaseException as error:  # also `SystemExit`
            fault = Fault.OUT_OF_MEMORY if isinstance(error, MemoryError) else Fault.CRASHED
            answer = {"fault": fault.name, "message": describe_error(error), "trace": traceback.format_exc()}
        if os.getpid() != process:
            os._exit(0)  # a fork of the algorithm's process, which must not answer a second time
        return answer

    def _load(self, path: list[str], spec: str) -> Any:
        """Import the class, function or stored object; `path` is the search path of the worker."""
        if self._factory is None:
            from marsyard.scenarios.imports import import_object

            sys.path += [folder for folder in path if folder not in sys.path]
            self._factory = import_object(spec)
        return self._factory

    def _describe(self, path: list[str], spec: str) -> dict[str, Any]:
        from marsyard.scenarios.isolation.description import describe_factory

        try:
            factory = self._load(path, spec)
        except ImportError as error:
            return {"error": str(error)}
        return describe_factory(factory)

    def _start(self, path: list[str], spec: str, device: str) -> dict[str, Any]:
        """Start a case: construct the algorithm, or reset it; return its members and whether each is a method."""
        from marsyard.scenarios.isolation.transport import Receiver

        self._receiver, self._is_seeded = Receiver(self._memory_fd), False
        # construction and `reset` depend neither on the process nor on earlier cases
        if self._algorithm is None:
            seed_generators(0)
            self._algorithm = construct(self._load(path, spec), device)
        seed_generators(0)
        reset(self._algorithm)
        return {"members": list_members(self._algorithm)}

    def _call(self, member: str, pickles: list[int], arrays: list[int]) -> dict[str, Any]:
        """Call a method with the arguments in the shared memory."""
        from marsyard.scenarios.isolation.plain import encode
        from marsyard.scenarios.isolation.transport import Layout

        arguments, checksum = self._receiver.receive(Layout(pickles, arrays))
        if checksum is not None and not self._is_seeded:
            seed_generators(checksum)
            self._is_seeded = True
        return {"value": encode(getattr(self._algorithm, member)(*arguments))}

    def _get(self, member: str) -> dict[str, Any]:
        from marsyard.scenarios.isolation.plain import encode

        return {"value": encode(getattr(self._algorithm, member))}


def construct(factory: Callable[..., Any], device: str) -> Any:
    """Construct an algorithm, here or in a worker; a factory with a parameter `device` receives the device."""
    parameters: Mapping[str, Any] = {}
    with contextlib.suppress(ValueError, TypeError):  # built-in classes have no signature
        parameters = inspect.signature(factory).parameters
    return factory(device=device) if "device" in parameters else factory()


def reset(algorithm: Any) -> None:
    """Reset an algorithm, here or in a worker, at the start of a case, if it has the method."""
    if callable(getattr(algorithm, "reset", None)):
        algorithm.reset()


def list_members(algorithm: Any) -> dict[str, bool]:
    """Return the public members of an algorithm, and whether each is a method."""
    names = [name for name in dir(algorithm) if not name.startswith("_")]
    return {name: _is_method(algorithm, name) for name in names}


def _is_method(algorithm: Any, name: str) -> bool:
    """Whether a member is a method; properties are not evaluated."""
    member = inspect.getattr_static(algorithm, name, None)
    return isinstance(member, staticmethod | classmethod) or callable(member)


def seed_generators(seed: int) -> None:
    """Seed the global generators of the loaded libraries, with a number that does not depend on earlier cases."""
    random.seed(seed)
    if "numpy" in sys.modules:
        sys.modules["numpy"].random.seed(seed)
    if "cv2" in sys.modules:
        sys.modules["cv2"].setRNGSeed(seed & 0x7FFFFFFF)  # a signed 32-bit integer


if __name__ == "__main__":
    main(int(sys.argv[1]))
