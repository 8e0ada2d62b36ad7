"""External programs as position estimators: messages, map files and answers (docs/custom-algorithms.md).

The estimator sends one request line per measurement and reads one answer line. `serve` is the other side: it answers
the requests with a Python estimator.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from io import TextIOBase
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from scipy.spatial.transform import Rotation

from marsyard.algorithms.exchange import Command, ExecutableLimits, ProgramDetails
from marsyard.algorithms.exchange.files import (
    ANSWER_VERSIONS,
    FORMAT_VERSION,
    check_version,
    encode_altitude,
    encode_increments,
    open_json,
    read_altitude,
    read_image,
    read_increments,
    write_images,
    write_json,
)
from marsyard.algorithms.exchange.process import MAX_STDERR_CHARACTERS
from marsyard.algorithms.exchange.serving import Answer, AnswerReader, Session, check_keys, read_member, read_numbers
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.answers import check_estimate
from marsyard.algorithms.localisation.interface import (
    InitialState,
    MapProduct,
    PositionEstimate,
    PositionEstimator,
    PositionOutcome,
)
from marsyard.sim.measurements import AltitudeMeasurement, DetectorImage, ImuIncrements

#: JSON files of an image and of a map.
IMAGE_FILE, MAP_FILE = "image.json", "map.json"
#: Numbers of `MapProduct` in the map file, and allowed keys of an estimate.
_MAP_KEYS = ("pixel_m", "registration_sd_m", "distortion_sd_m", "elevation_sd_m")
_ANSWER_KEYS = {"outcome", "time_s", "position_m", "velocity_m_s", "world_from_body_xyzw", "covariance"}
#: Largest difference of a quaternion's norm from 1 in an answer.
_MAX_NORM_ERROR = 1e-3


class ExecutablePositionEstimator:
    """`PositionEstimator` that runs an external program: one JSON request line per call.

    With the prefix `serve:`, one process of the program answers many descents; `start` resets it.
    Methods raise AlgorithmError if the program fails, exceeds a limit, or its answer has the wrong form.

    - request_time_s: wall-clock time of the program's last answer
    """

    def __init__(self, command: Command, limits: ExecutableLimits) -> None:
        self._session = Session(command, limits)
        self._total = ProgramDetails("", 0.0)  # standard error and time of all answers of a descent
        self._start_s = -math.inf
        self.request_time_s = 0.0

    def start(self, initial: InitialState, map_product: MapProduct) -> None:
        """Start a new descent: send the initial state and the map."""
        self._total, self._start_s = ProgramDetails("", 0.0), initial.time_s
        files = {"map": lambda folder: write_map(folder, map_product)}
        self._session.send_request("start", {"initial": encode_initial(initial)}, self._record_time(_read_none), files)

    def imu(self, increments: ImuIncrements) -> None:
        """Send the next inertial increments."""
        self._session.send_request("imu", {"increments": encode_increments(increments)}, self._record_time(_read_none))

    def altitude(self, measurement: AltitudeMeasurement) -> None:
        """Send an altitude."""
        self._session.send_request(
            "altitude", {"altitude": encode_altitude(measurement)}, self._record_time(_read_none)
        )

    def image(self, image: DetectorImage) -> PositionEstimate:
        """Send the next image; return the program's estimate, with the standard error and time of this answer."""
        files = {"image": lambda folder: write_image(folder, image)}
        return self._session.send_request("image", {}, self._record_time(self._read_estimate), files)

    def finish(self) -> PositionEstimate:
        """Return the final estimate; its details contain the standard error and the time of the whole descent."""
        answer = self._session.send_request("finish", {}, self._record_time(self._read_estimate))
        return replace(answer, details=self._total)

    def _record_time(self, read: AnswerReader[Answer]) -> AnswerReader[Answer]:
        """Return a reader that also adds the answer's standard error and time to those of the descent."""

        def read_timed(answer: Mapping[str, Any], details: ProgramDetails) -> Answer:
            self.request_time_s = details.time_s
            stderr = (self._total.stderr + details.stderr)[-MAX_STDERR_CHARACTERS:]
            self._total = ProgramDetails(stderr, self._total.time_s + details.time_s)
            return read(answer, details)

        return read_timed

    def _read_estimate(self, answer: Mapping[str, Any], details: ProgramDetails) -> PositionEstimate:
        """Decode and validate an estimate."""
        estimate = read_estimate(answer)
        # the end of the inertial data is not known here
        return check_estimate(replace(estimate, details=details), (self._start_s, math.inf))


def _read_none(answer: Mapping[str, Any], _details: ProgramDetails) -> None:
    """Check the answer to a request that expects no estimate."""
    check_keys(answer, {"outcome"})
    if answer.get("outcome", "") is not None:
        raise bad_answer(f"outcome is {answer.get('outcome')!r}; only image and finish have an outcome; allowed: null")


def encode_initial(initial: InitialState) -> dict[str, Any]:
    """Encode the initial state for JSON."""
    vectors = {name: getattr(initial, name).tolist() for name in ("position_m", "velocity_m_s", "covariance")}
    attitude = initial.world_from_body.as_quat().tolist()
    scalars = {"time_s": initial.time_s, "gravity_m_s2": initial.gravity_m_s2}
    return {**scalars, **vectors, "world_from_body_xyzw": attitude}


def read_initial(content: Mapping[str, Any]) -> InitialState:
    """Decode the initial state that `encode_initial` encoded."""
    return InitialState(
        time_s=content["time_s"],
        position_m=np.array(content["position_m"], dtype=np.float64),
        velocity_m_s=np.array(content["velocity_m_s"], dtype=np.float64),
        world_from_body=Rotation.from_quat(content["world_from_body_xyzw"]),
        covariance=np.array(content["covariance"], dtype=np.float64),
        gravity_m_s2=content["gravity_m_s2"],
    )


def write_map(folder: Path, map_product: MapProduct) -> None:
    """Write a map into an existing folder: two rasters of little-endian float32, row by row, and a table."""
    rows, columns = map_product.appearance.shape
    content: dict[str, Any] = {"exchange": FORMAT_VERSION, "rows": rows, "columns": columns}
    for name in ("appearance", "elevation"):
        content[name] = f"{name}.f32"
    map_product.appearance.astype("<f4").tofile(folder / content["appearance"])
    map_product.elevation_m.astype("<f4").tofile(folder / content["elevation"])
    content["origin_m"] = map_product.origin_m.tolist()
    write_json(folder / MAP_FILE, {**content, **{name: getattr(map_product, name) for name in _MAP_KEYS}})


def read_map(folder: Path) -> MapProduct:
    """Read the map that `write_map` wrote. Raises ValueError if it is missing or has another version."""

    def read_raster(file: str) -> Float32[np.ndarray, "rows columns"]:
        values = np.fromfile(folder / file, dtype="<f4").reshape(content["rows"], content["columns"])
        return np.asarray(values, dtype=np.float32)

    with open_json(folder / MAP_FILE, "map") as content:
        check_version(content)
        origin = np.array(content["origin_m"], dtype=np.float64)
        appearance, elevation = read_raster(content["appearance"]), read_raster(content["elevation"])
        return MapProduct(appearance, elevation, origin, **{name: content[name] for name in _MAP_KEYS})


def write_image(folder: Path, image: DetectorImage) -> None:
    """Write an image, its camera and its flat field into an existing folder."""
    (record,) = write_images(folder, [image], "pgm")
    write_json(folder / IMAGE_FILE, {"exchange": FORMAT_VERSION, "image": record})


def read_descent_image(folder: Path) -> DetectorImage:
    """Read the image that `write_image` wrote. Raises ValueError if it is missing or has another version."""
    with open_json(folder / IMAGE_FILE, "descent image") as content:
        check_version(content)
        return read_image(folder, content["image"])


def encode_estimate(estimate: PositionEstimate) -> dict[str, Any]:
    """Encode an estimate as an answer; the details are omitted."""
    answer: dict[str, Any] = {"outcome": estimate.outcome.name, "time_s": float(estimate.time_s)}
    for name in ("position_m", "velocity_m_s", "covariance"):
        value = getattr(estimate, name)
        answer |= {} if value is None else {name: np.asarray(value, dtype=np.float64).tolist()}
    attitude = estimate.world_from_body
    return answer if attitude is None else {**answer, "world_from_body_xyzw": attitude.as_quat().tolist()}


def read_estimate(answer: Mapping[str, Any]) -> PositionEstimate:
    """Decode an answer; raises AlgorithmError (BAD_ANSWER). Its consistency is not checked."""
    check_keys(answer, _ANSWER_KEYS)
    outcome = read_member("outcome", answer.get("outcome"), PositionOutcome)
    time_s, attitude = read_numbers(answer, "time_s", ()), read_numbers(answer, "world_from_body_xyzw", (4,))
    if time_s is None:
        raise bad_answer("time_s is missing; expected the time tag of the state")
    if attitude is not None and abs(float(np.linalg.norm(attitude)) - 1.0) > _MAX_NORM_ERROR:
        raise bad_answer(f"world_from_body_xyzw is {attitude.tolist()}; allowed: a unit quaternion, scalar last")
    return PositionEstimate(
        outcome,
        float(time_s),
        read_numbers(answer, "position_m", (3,)),
        read_numbers(answer, "velocity_m_s", (3,)),
        None if attitude is None else Rotation.from_quat(attitude),
        read_numbers(answer, "covariance", (9, 9)),
    )


def serve(
    estimator: PositionEstimator, requests: Iterable[str] | None = None, answers: TextIOBase | None = None
) -> None:
    """Answer the requests on standard input with an estimator, one line each, until the input ends.

    The estimator's own output goes to standard error. Its exceptions end the program.
    """
    version, output = ANSWER_VERSIONS[-1], sys.stdout if answers is None else answers
    print(json.dumps({"exchange": version, "ready": True}), file=output, flush=True)
    with redirect_stdout(sys.stderr):
        for line in sys.stdin if requests is None else requests:
            request = json.loads(line)
            answer = _answer_request(estimator, request)
            content = {"outcome": None} if answer is None else encode_estimate(answer)
            print(json.dumps({"exchange": version, "id": request["id"], **content}), file=output, flush=True)


def _answer_request(estimator: PositionEstimator, request: Mapping[str, Any]) -> PositionEstimate | None:
    """Call the estimator's method for a request. Raises ValueError for an unknown request."""
    action = request["do"]
    if action == "start":
        estimator.start(read_initial(request["initial"]), read_map(Path(request["map"])))
    elif action == "imu":
        estimator.imu(read_increments(request["increments"]))
    elif action == "altitude":
        estimator.altitude(read_altitude(request["altitude"]))
    elif action == "image":
        return estimator.image(read_descent_image(Path(request["image"])))
    elif action == "finish":
        return estimator.finish()
    else:
        raise ValueError(f"unknown request '{action}'; allowed: start, imu, altitude, image, finish")
    return None
