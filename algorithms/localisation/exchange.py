"""Position estimators as programs: validation of their answers, and exchange of initial state, map files and answers.

`POSITION_STREAM.serve` answers the requests of a campaign with a Python estimator (docs/custom-algorithms.md).
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from marsyard.algorithms.answers import check_covariance, check_numbers, check_type
from marsyard.algorithms.exchange import files
from marsyard.algorithms.exchange.forms import AnswerForm
from marsyard.algorithms.exchange.streams import StreamForm
from marsyard.algorithms.exchange.values import decode, encode
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.interface import InitialState, MapProduct, PositionEstimate, PositionOutcome

#: JSON file of a map.
MAP_FILE = "map.json"
#: Key of the attitude in an answer.
_ATTITUDE = "world_from_body_xyzw"
#: Largest difference of a quaternion's norm from 1 in an answer.
_MAX_NORM_ERROR = 1e-3


def check_estimate(answer: Any) -> PositionEstimate:
    """Validate a `PositionEstimate`, except its time; return a copy with plain arrays.

    Raises AlgorithmError (BAD_ANSWER) with the reason.
    """
    check_type("the answer", answer, PositionEstimate)
    check_type("outcome", answer.outcome, PositionOutcome)
    if not isinstance(answer.time_s, float | int) or not math.isfinite(answer.time_s):
        raise bad_answer(f"time_s is {answer.time_s!r}; allowed: a finite number")
    state = {name: getattr(answer, name) for name in ("position_m", "velocity_m_s", "world_from_body", "covariance")}
    is_valid = answer.outcome is PositionOutcome.VALID
    for name, value in state.items():
        if is_valid != (value is not None):
            problem = "is missing" if value is None else "is given"
            allowed = "all parts of the state if and only if the outcome is VALID"
            raise bad_answer(f"outcome is {answer.outcome.name}, but {name} {problem}; allowed: {allowed}")
    if not is_valid:
        refusal: PositionEstimate = answer
        return replace(refusal, time_s=float(answer.time_s))
    check_type("world_from_body", answer.world_from_body, Rotation)
    if not answer.world_from_body.single:
        raise bad_answer(f"world_from_body contains {len(answer.world_from_body)} rotations; allowed: one")
    if not np.all(np.isfinite(answer.world_from_body.as_quat())):
        raise bad_answer("world_from_body is not finite")
    covariance = np.asarray(check_numbers("covariance", answer.covariance, (9, 9)))
    check_covariance("covariance", covariance)
    estimate: PositionEstimate = answer
    return replace(
        estimate,
        time_s=float(answer.time_s),
        position_m=check_numbers("position_m", answer.position_m, (3,)),
        velocity_m_s=check_numbers("velocity_m_s", answer.velocity_m_s, (3,)),
        covariance=covariance,
    )


def write_map(folder: Path, map_product: MapProduct) -> None:
    """Write a map into an existing folder: two rasters of little-endian float32, row by row, and a table."""
    rows, columns = map_product.appearance.shape
    content: dict[str, Any] = {"exchange": files.EXCHANGE_VERSION, "rows": rows, "columns": columns}
    for name, raster in (("appearance", map_product.appearance), ("elevation", map_product.elevation_m)):
        content[name] = f"{name}.f32"
        raster.astype("<f4").tofile(folder / content[name])
    files.write_json(folder / MAP_FILE, {**content, **encode(map_product, ["appearance", "elevation_m"])})


def read_map(folder: Path) -> MapProduct:
    """Read the map that `write_map` wrote. Raises ValueError if it is missing or has another version."""
    with files.open_json(folder / MAP_FILE, "map") as content:
        files.check_version(content)
        shape = content["rows"], content["columns"]
        appearance, elevation = (
            np.fromfile(folder / content[name], dtype="<f4").reshape(shape).astype(np.float32)
            for name in ("appearance", "elevation")
        )
        return decode(MapProduct, content, appearance=appearance, elevation_m=elevation)


def _create_estimate(
    time_s: np.ndarray | None, world_from_body_xyzw: np.ndarray | None, **values: Any
) -> PositionEstimate:
    """Create and check an estimate; its time is compared with those of the images later. Raises AlgorithmError."""
    if time_s is None:
        raise bad_answer("time_s is missing; expected the time tag of the state")
    attitude = world_from_body_xyzw
    if attitude is not None and abs(float(np.linalg.norm(attitude)) - 1.0) > _MAX_NORM_ERROR:
        raise bad_answer(f"{_ATTITUDE} is {attitude.tolist()}; allowed: a unit quaternion, scalar last")
    rotation = None if attitude is None else Rotation.from_quat(attitude)
    estimate = PositionEstimate(time_s=float(time_s), world_from_body=rotation, **values)
    return check_estimate(estimate)


def _get_numbers(estimate: PositionEstimate, key: str) -> Any:
    """Return the numbers of an estimate by their key in an answer."""
    if key != _ATTITUDE:
        return getattr(estimate, key)
    return None if estimate.world_from_body is None else estimate.world_from_body.as_quat()


def _encode_start(initial: InitialState, map_product: MapProduct) -> dict[str, Any]:
    return {"initial": encode(initial), "map": lambda folder: write_map(folder, map_product)}


POSITION_FORM = AnswerForm(
    PositionOutcome,
    {"time_s": (), "position_m": (3,), "velocity_m_s": (3,), _ATTITUDE: (4,), "covariance": (9, 9)},
    _create_estimate,
    _get_numbers,
)
#: Exchange of position estimators.
POSITION_STREAM = StreamForm(
    POSITION_FORM,
    files.write_image,
    files.read_detector_image,
    _encode_start,
    lambda request: (decode(InitialState, request["initial"]), read_map(Path(request["map"]))),
)
