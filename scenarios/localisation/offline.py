"""Files for position estimators on another computer: exported measurements of a descent, and tables of estimates.

`write_descent` writes the measurements of a descent to a folder, and `read_descent` reads them again. A table has one
line for each estimate of a descent: one per image, in the order of the images, then the final estimate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from marsyard.algorithms.exchange.files import (
    ANSWER_VERSIONS,
    CASE_FILE,
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
from marsyard.algorithms.faults import bad_answer
from marsyard.algorithms.localisation.answers import check_estimate
from marsyard.algorithms.localisation.exchange import encode_initial, read_estimate, read_initial, read_map, write_map
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.localisation.stream import LocalisationMeasurements, ProcessorTimes, StreamAnswers
from marsyard.scenarios.offline import AnswerFormat

#: Columns of position, velocity and attitude, by their keys in the exchange with programs.
_STATE_COLUMNS: Mapping[str, tuple[str, ...]] = {
    "position_m": ("position_east_m", "position_north_m", "position_up_m"),
    "velocity_m_s": ("velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s"),
    "world_from_body_xyzw": tuple(f"world_from_body_{name}" for name in "xyzw"),
}
#: Rows and columns of the covariance's upper triangle, row by row.
_UPPER = np.triu_indices(9)
_COVARIANCE_COLUMNS = tuple(f"covariance_{row}_{column}" for row, column in zip(*_UPPER, strict=True))


def write_descent(folder: Path, measurements: LocalisationMeasurements) -> None:
    """Write the measurements of a descent into an existing folder. Raises OSError if that fails."""
    write_map(folder, measurements.map_product)
    content = {
        "task": "localisation",
        "initial": encode_initial(measurements.initial),
        "increments": encode_increments(measurements.increments),
        "altitudes": [encode_altitude(altitude) for altitude in measurements.altitudes],
        "images": write_images(folder, measurements.images, "png"),
    }
    write_json(folder / CASE_FILE, {"exchange": FORMAT_VERSION, **content})


def read_descent(folder: Path) -> LocalisationMeasurements:
    """Read the descent that `write_descent` wrote. Raises ValueError if it is missing or has another version."""
    with open_json(folder / CASE_FILE, "case") as content:
        check_version(content)
        return LocalisationMeasurements(
            initial=read_initial(content["initial"]),
            map_product=read_map(folder),
            increments=read_increments(content["increments"]),
            altitudes=tuple(read_altitude(record) for record in content["altitudes"]),
            images=tuple(read_image(folder, record) for record in content["images"]),
        )


def _create_estimate(outcome: Enum, numbers: Mapping[str, float]) -> PositionEstimate:
    """Convert one line of a table to an estimate, with the checks of a program's answer. Raises AlgorithmError."""
    content: dict[str, object] = {
        "exchange": ANSWER_VERSIONS[-1],
        "outcome": outcome.name,
        "time_s": numbers.get("time_s"),
    }
    for key, columns in _STATE_COLUMNS.items():
        if columns[0] in numbers:
            content[key] = [numbers[name] for name in columns]
    if _COVARIANCE_COLUMNS[0] in numbers:
        covariance = np.zeros((9, 9))
        covariance[_UPPER] = covariance.T[_UPPER] = [numbers[name] for name in _COVARIANCE_COLUMNS]
        content["covariance"] = covariance.tolist()
    return check_estimate(read_estimate(content), (-math.inf, math.inf))


def _join(estimates: Sequence[PositionEstimate]) -> tuple[PositionEstimate, ...]:
    """Collect the estimates in the lines of a descent. Raises ValueError if their times decrease."""
    for earlier, later in pairwise(estimates):
        if later.time_s < earlier.time_s:
            raise ValueError(f"time_s is {later.time_s:g} after {earlier.time_s:g}; allowed: the order of the images")
    return tuple(estimates)


def _create_answers(estimates: tuple[PositionEstimate, ...], measurements: LocalisationMeasurements) -> StreamAnswers:
    """Create the answers to a descent from its estimates. Raises AlgorithmError for a wrong number of estimates."""
    n_images = len(measurements.images)
    if len(estimates) != n_images + 1:
        raise bad_answer(
            f"the table has {len(estimates)} answers to this case; allowed: {n_images + 1}, one for each of its "
            f"{n_images} images and the final one"
        )
    return StreamAnswers(estimates, _unknown_times(n_images))


def _refuse(measurements: LocalisationMeasurements) -> StreamAnswers:
    """Return a refusal: an export produces no estimates."""
    end_s = float(measurements.increments.times_s[-1])
    return StreamAnswers((PositionEstimate(PositionOutcome.NO_COARSE_FIX, end_s),), _unknown_times(0))


def _unknown_times(n_images: int) -> ProcessorTimes:
    """Return NaN for all processor times: the other computer does not report them."""
    return ProcessorTimes(math.nan, (), (), (math.nan,) * n_images, math.nan)


#: Format of a table of answers; lines are `PositionEstimate`, the answer to a case is `StreamAnswers`.
POSITION_FORMAT: AnswerFormat[Any] = AnswerFormat(
    required=("time_s",),
    optional=(tuple(name for columns in _STATE_COLUMNS.values() for name in columns) + _COVARIANCE_COLUMNS,),
    outcomes=PositionOutcome,
    create_answer=_create_estimate,
    create_empty=_refuse,
    add_inputs=_create_answers,
    note=(
        "A descent has one line for each image, in the order of the images, and a last line for the end of the\n"
        "inertial data. All lines have `time_s`; lines with the outcome VALID have all other numbers, lines with\n"
        "another outcome none of them. `world_from_body_x` to `_w` is the attitude as a unit quaternion, scalar last.\n"
        "`covariance_I_J` is the element in row I and column J, from 0, of the covariance of the errors of position\n"
        "(m), velocity (m/s) and attitude (rad, world axes)."
    ),
    write_inputs=write_descent,
    join=_join,
)
