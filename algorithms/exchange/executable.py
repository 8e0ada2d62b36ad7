"""External programs as algorithms: the arguments of a call are written to a request and to files, the answer is JSON.

Each task declares the requests of its programs: `VELOCITY_REQUESTS`, `SITE_REQUESTS`, `TRACKER_REQUESTS`, and
`marsyard.algorithms.exchange.streams.StreamForm.requests` for streams.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from marsyard.algorithms import interface
from marsyard.algorithms.answers import check_aim, check_update
from marsyard.algorithms.exchange.files import encode_rover_pose, write_case, write_mast, write_stop
from marsyard.algorithms.exchange.forms import (
    SITE_FORM,
    VELOCITY_FORM,
    AnswerForm,
    ProgramDetails,
    check_keys,
    read_member,
    read_numbers,
)
from marsyard.algorithms.exchange.limits import ExecutableLimits
from marsyard.algorithms.exchange.process import MAX_STDERR_CHARACTERS
from marsyard.algorithms.exchange.serving import Command, KeptFolder, Session, run_once
from marsyard.algorithms.exchange.values import encode
from marsyard.algorithms.faults import AlgorithmError, bad_answer
from marsyard.sim.measurements import MastCalibration, RoverMeasurements

#: Method of an algorithm that receives all measurements of a case at once.
ESTIMATE = "estimate"


@dataclass(frozen=True)
class Request:
    """Request to a program for one call of a method.

    - encode: returns the values of the request from the arguments of the call; a value that is a function or a
      `KeptFolder` writes files, and the request contains the path of their folder
    - read: decodes the answer from its JSON object, the details, and the arguments of the call. Raises AlgorithmError
      (BAD_ANSWER).
    """

    encode: Callable[..., Mapping[str, Any]]
    read: Callable[..., Any]


class ExecutableAlgorithm:
    """Algorithm that runs an external program; its methods are those of `requests` (docs/custom-algorithms.md).

    Methods raise AlgorithmError if the program fails, exceeds a limit, or its answer has the wrong form. The process of
    a persistent program answers many cases; any other process ends with this object, or after the answer to `estimate`.
    """

    def __init__(self, command: Command, limits: ExecutableLimits, requests: Mapping[str, Request]) -> None:
        self.command, self.limits = command, limits
        self._requests = requests
        self._session = Session(command, limits)
        self._total = ProgramDetails("", 0.0)  # of all answers since `start`

    def __getattr__(self, name: str) -> Any:
        """Return the method of a request."""
        if name not in self.__dict__.get("_requests", {}):
            raise AttributeError(f"the program has no request {name}")
        return partial(self._call, name)

    def __dir__(self) -> list[str]:
        """Return the names of the requests."""
        return sorted(self._requests)

    def _call(self, name: str, *arguments: Any) -> Any:
        """Send a request and return the answer; the details of `finish` are those of all answers since `start`."""
        request = self._requests[name]
        values = request.encode(*arguments)
        is_single = name == ESTIMATE and not self.command.persistent
        if is_single:
            answer, output = run_once(self.command, self.limits, values["case"])
        else:
            answer, output = self._session.send_request(name, values)
        details = ProgramDetails(output.stderr, output.time_s)
        total = ProgramDetails("", 0.0) if name == "start" else self._total
        stderr = (total.stderr + details.stderr)[-MAX_STDERR_CHARACTERS:]
        self._total = ProgramDetails(stderr, total.time_s + details.time_s)
        try:
            return request.read(answer, self._total if name == "finish" else details, *arguments)
        except AlgorithmError as error:
            raise AlgorithmError(error.fault, str(error), output.stderr) from error


class ExecutableTargetTracker(ExecutableAlgorithm):
    """Target tracker that runs an external program.

    - state: state of the tracker according to its last answer
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        super().__init__(command, limits, TRACKER_REQUESTS)
        self.state = interface.TrackingState.NO_TARGET

    def _call(self, name: str, *arguments: Any) -> Any:
        """Send a request and store the state in its answer."""
        answer = super()._call(name, *arguments)
        if name != "aim":
            self.state = answer.state if isinstance(answer, interface.TargetUpdate) else answer
        return answer


def _estimate_requests(form: AnswerForm[Any]) -> Mapping[str, Request]:
    """Return the request of an estimator, which receives the files of a case."""
    return {ESTIMATE: Request(lambda case: {"case": lambda folder: write_case(folder, case)}, form.read)}


# Functions that decode an answer of a tracker; they raise AlgorithmError (BAD_ANSWER) if it does not conform to the
# exchange format.


def _read_state(answer: Mapping[str, Any], _details: ProgramDetails, *_arguments: Any) -> interface.TrackingState:
    check_keys(answer, {"state"})
    return read_member("state", answer.get("state"), interface.TrackingState)


def _read_aim(
    answer: Mapping[str, Any], _details: ProgramDetails, _pose: Any, mast: MastCalibration
) -> interface.MastAim | None:
    check_keys(answer, {"aim"})
    aim = answer.get("aim")
    if aim is None:
        return None
    if not isinstance(aim, dict):
        raise bad_answer(f"aim is {aim!r}; allowed: null, or a table of azimuth_rad, elevation_rad, left, right")
    angles = [read_numbers(aim, name, ()) for name in ("azimuth_rad", "elevation_rad")]
    if angles[0] is None or angles[1] is None:
        raise bad_answer("an angle of aim is missing; expected azimuth_rad and elevation_rad")
    boxes = _read_box(aim, "left"), _read_box(aim, "right")
    return check_aim(interface.MastAim(float(angles[0]), float(angles[1]), *boxes), mast)


def _read_box(aim: Mapping[str, Any], name: str) -> interface.PixelBox:
    box = aim.get(name)
    corner, size = (box.get("corner"), box.get("size")) if isinstance(box, dict) else (None, None)
    if not isinstance(corner, list) or not isinstance(size, list) or not len(corner) == len(size) == 2:
        raise bad_answer(f'{name} is {box!r}; allowed: {{"corner": [column, row], "size": [columns, rows]}}')
    return interface.PixelBox((corner[0], corner[1]), (size[0], size[1]))


def _read_update(
    answer: Mapping[str, Any], details: ProgramDetails, _measurements: RoverMeasurements
) -> interface.TargetUpdate:
    check_keys(answer, {"state", "losses", "position_rover"})
    losses = answer.get("losses", [])
    if not isinstance(losses, list):
        raise bad_answer(f"losses is {losses!r}; allowed: a list of {', '.join(interface.TargetLoss.__members__)}")
    position = read_numbers(answer, "position_rover", (3,))
    state = read_member("state", answer.get("state"), interface.TrackingState)
    decoded_losses = tuple(read_member("a loss", loss, interface.TargetLoss) for loss in losses)
    return check_update(interface.TargetUpdate(state, decoded_losses, position, details))


#: Requests of the tasks' programs, by method.
VELOCITY_REQUESTS, SITE_REQUESTS = _estimate_requests(VELOCITY_FORM), _estimate_requests(SITE_FORM)
TRACKER_REQUESTS: Mapping[str, Request] = {
    "designate": Request(lambda target, pose: {"target": encode(target), **encode_rover_pose(pose)}, _read_state),
    "aim": Request(lambda pose, mast: {**encode_rover_pose(pose), "mast": KeptFolder(mast, write_mast)}, _read_aim),
    "update": Request(
        lambda stop: {"mast": KeptFolder(stop.mast, write_mast), "stop": lambda folder: write_stop(folder, stop)},
        _read_update,
    ),
    "clear": Request(dict, _read_state),
}
