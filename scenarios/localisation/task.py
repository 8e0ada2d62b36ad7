"""Task of the position estimators: names of the algorithms, and files for estimators on another computer.

`write_descent` writes the measurements of a descent to a folder, and `read_descent` reads them again. A table has one
line for each estimate of a descent: one per image, in the order of the images, then the final estimate.
"""

import math
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from marsyard.algorithms.exchange import ExecutableAlgorithm, files
from marsyard.algorithms.exchange.values import decode, encode
from marsyard.algorithms.localisation.baselines import FeatureEstimator, InertialEstimator
from marsyard.algorithms.localisation.estimator import MapRelativeEstimator
from marsyard.algorithms.localisation.exchange import POSITION_FORM, POSITION_STREAM, read_map, write_map
from marsyard.algorithms.localisation.interface import PositionEstimate, PositionEstimator, PositionOutcome
from marsyard.algorithms.localisation.options import LvsOptions
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.offline_algorithms import AnswerFormat
from marsyard.scenarios.streamed import StreamAnswers
from marsyard.scenarios.tasks import Task


def write_descent(folder: Path, measurements: LocalisationMeasurements) -> None:
    """Write the measurements of a descent into an existing folder. Raises OSError if that fails."""
    write_map(folder, measurements.map_product)
    images = files.write_images(folder, measurements.images, "png")
    content = encode(measurements, ["map_product", "images"])
    files.write_json(
        folder / files.CASE_FILE,
        {"exchange": files.EXCHANGE_VERSION, "task": "localisation", **content, "images": images},
    )


def read_descent(folder: Path) -> LocalisationMeasurements:
    """Read the descent that `write_descent` wrote. Raises ValueError if it is missing or has another version."""
    with files.open_json(folder / files.CASE_FILE, "case") as content:
        files.check_version(content)
        images = tuple(files.read_image(folder, record) for record in content["images"])
        return decode(LocalisationMeasurements, content, map_product=read_map(folder), images=images)


def _join(estimates: Sequence[PositionEstimate]) -> StreamAnswers[PositionEstimate]:
    """Collect the estimates in the lines of a descent. Raises ValueError if their times decrease."""
    for earlier, later in pairwise(estimates):
        if later.time_s < earlier.time_s:
            raise ValueError(f"time_s is {later.time_s:g} after {earlier.time_s:g}; allowed: the order of the images")
    # the other computer does not report its times
    return StreamAnswers(tuple(estimates[:-1]), estimates[-1], (math.nan,) * (len(estimates) - 1))


def _create_refusals(measurements: LocalisationMeasurements) -> StreamAnswers[PositionEstimate]:
    """Create the refusals that a run returns if it only exports the measurements: it produces no estimates."""
    refusals = [PositionEstimate(PositionOutcome.NO_COARSE_FIX, time_s) for time_s in measurements.answer_times_s]
    return StreamAnswers(tuple(refusals[:-1]), refusals[-1])


#: Format of a table of answers; the answer to a case is `StreamAnswers`.
POSITION_FORMAT = AnswerFormat(
    form=POSITION_FORM,
    numbers={
        "time_s": ("time_s",),
        "position_m": ("position_east_m", "position_north_m", "position_up_m"),
        "velocity_m_s": ("velocity_east_m_s", "velocity_north_m_s", "velocity_up_m_s"),
        "world_from_body_xyzw": tuple(f"world_from_body_{name}" for name in "xyzw"),
        "covariance": tuple(f"covariance_{row}_{column}" for row, column in zip(*np.triu_indices(9), strict=True)),
    },
    required=("time_s",),
    create_refusal=_create_refusals,
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


LOCALISATION: Task[PositionEstimator, LvsOptions] = Task(
    name="localisation",
    noun="position estimator",
    methods=(),  # none receives all measurements at once: all are streams
    answers=(PositionEstimate, PositionOutcome),
    shipped={"lvs": MapRelativeEstimator, "sift": FeatureEstimator, "inertial": InertialEstimator},
    executable=partial(ExecutableAlgorithm, requests=POSITION_STREAM.requests),
    options=LvsOptions,
    offline=POSITION_FORMAT,
    accepts_streams=True,
    suite="marsyard.scenarios.localisation.conformance:position_suite",
)
