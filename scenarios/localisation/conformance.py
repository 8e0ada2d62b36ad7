"""Conformance suite of position estimators: the rules for the answers to synthetic descents.

A position estimator follows the interface `marsyard.algorithms.localisation.interface.PositionEstimator`: it receives
the measurements of a descent one by one, and answers each image, and the end of the descent, with a position.
`StreamSuite` runs the checks that all streams have in common; the `SuiteRules` of this module gives it the descents
(`conformance_inputs`: level, textured ground, without a renderer), and the check of their answers.
`position_suite(...)` creates the suite for one estimator (`marsyard conformance`).
"""

from functools import partial
from typing import Any

import numpy as np

from marsyard.algorithms.localisation.interface import PositionEstimate, PositionOutcome
from marsyard.scenarios.conformance.checks import BreachError
from marsyard.scenarios.conformance.estimators import StreamSuite, SuiteRules, Unusual, unusual_images
from marsyard.scenarios.localisation import conformance_inputs as inputs
from marsyard.scenarios.localisation.measurements import LocalisationMeasurements
from marsyard.scenarios.streamed import StreamAnswers

#: Maximum difference between the time of an answer and the time tag of its image, or of the last increment, s.
_TIME_TOLERANCE_S = 1e-6


def check_answers(answer: Any, measurements: LocalisationMeasurements) -> StreamAnswers[PositionEstimate]:
    """Return the answers to a descent if they are valid, and have the time tags of their images.

    Raises AlgorithmError for an invalid answer, and BreachError for another time.
    """
    answers = measurements.check(answer)
    tags_s = [*sorted(image.time_s for image in measurements.images), float(measurements.increments.times_s[-1])]
    for number, (estimate, tag_s) in enumerate(zip(answers.estimates, tags_s, strict=True), start=1):
        if abs(estimate.time_s - tag_s) > _TIME_TOLERANCE_S:
            name = f"image {number}" if number < len(tags_s) else "finish"
            raise BreachError(f"the time_s of its answer to {name} is {estimate.time_s} s; expected {tag_s} s")
    return answers


def describe_answers(answers: StreamAnswers[PositionEstimate]) -> str:
    """Return the number of positions, and the outcome or the horizontal error at the end."""
    valid = sum(estimate.outcome is PositionOutcome.VALID for estimate in answers.after_images)
    final = answers.final
    end = final.outcome.name
    if final.position_m is not None:
        error_m = float(np.hypot(*(final.position_m - inputs.true_position(final.time_s))[:2]))
        end = f"{error_m:.1f} m error at the end"
    return f"{valid} of {len(answers.after_images)} images {PositionOutcome.VALID.name}; {end}"


#: The descents of the suite, and the rules for their answers.
POSITION = SuiteRules(
    measurements=inputs.ordinary_descent,
    check=check_answers,
    is_valid=lambda answers: answers.outcome is PositionOutcome.VALID,
    describe=describe_answers,
    failures=", ".join(outcome.name for outcome in PositionOutcome if outcome is not PositionOutcome.VALID),
    unusual={
        # a position is no violation here: inertial navigation gives one also with blank images
        **unusual_images(inputs.ordinary_descent, inputs.BLANK_COUNTS, ""),
        "repeated": Unusual(
            "images that repeat the first, each delivered twice", (inputs.descent_with_repeated_images,)
        ),
        "no-altitudes": Unusual("a descent without altitudes", (inputs.descent_without_altitudes,)),
        "no-images": Unusual("a descent without images", (inputs.descent_without_images,)),
        "jitter": Unusual("time tags with jitter, some of them equal", (inputs.descent_with_jitter,)),
    },
    interface="algorithms/localisation/interface.py",
    interrupted=inputs.descent_on_shifted_map,
)
position_suite = partial(StreamSuite, rules=POSITION)
