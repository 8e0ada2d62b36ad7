"""Velocity estimators: their task, the format of their answers in tables, and their runs.

The answer of a velocity estimator is a mean velocity over a span: the interval between two time tags. The truth of an
answer is the true mean velocity over the same span.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64, UInt16

from marsyard.algorithms import exchange
from marsyard.algorithms.answers import check_and_set_span
from marsyard.algorithms.dimes import DimesDetails, DimesEstimator, DimesOptions, dimes_products
from marsyard.algorithms.dimes.baselines import HomographyEstimator, PhaseCorrelationEstimator
from marsyard.algorithms.dimes.options import IMPROVEMENTS
from marsyard.algorithms.dimes.views import check_binning
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import VelocityEstimate, VelocityEstimator, VelocityOutcome
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
from marsyard.scenarios.interface import Scalar
from marsyard.scenarios.offline_algorithms import AnswerFormat, CaseExporter, RecordedAnswer
from marsyard.scenarios.streamed import StreamAnswers, StreamedEstimator
from marsyard.scenarios.tasks import Task, variants
from marsyard.sim.measurements import DescentMeasurements

#: Indices of three images.
ImageTriple = tuple[int, int, int]

_FIRST_TRIPLE: ImageTriple = (0, 1, 2)

#: Format of a table of velocities.
VELOCITY_FORMAT = AnswerFormat(
    form=exchange.VELOCITY_FORM,
    numbers={
        "velocity_m_s": ("velocity_east_m_s", "velocity_north_m_s"),
        "covariance_m2_s2": ("covariance_east_m2_s2", "covariance_east_north_m2_s2", "covariance_north_m2_s2"),
        "span_s": ("start_s", "end_s"),
    },
    required=("velocity_m_s",),
    create_empty=lambda _: VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None),
    note="A velocity is the mean between the last two images, or between the time tags `start_s` and `end_s`.",
)
VELOCITY: Task[VelocityEstimator, DimesOptions] = Task(
    name="velocity",
    noun="velocity estimator",
    methods=("estimate",),
    answers=(VelocityEstimate, VelocityOutcome),
    shipped={
        **variants("dimes", DimesEstimator, IMPROVEMENTS),
        "phase-correlation": lambda _: PhaseCorrelationEstimator(),
        "homography": lambda _: HomographyEstimator(),
    },
    # a program receives three images at once, or all images one by one
    executable=lambda command, limits: exchange.ExecutableAlgorithm(
        command, limits, exchange.VELOCITY_STREAM.requests if command.stream else exchange.VELOCITY_REQUESTS
    ),
    options=DimesOptions,
    offline=VELOCITY_FORMAT,
    accepts_streams=True,
)

Horizontal = Float64[np.ndarray, "2"]
#: Time tags of the start and end of the interval of a mean velocity; equal for an instantaneous velocity.
Span = tuple[float, float]


def check_image_size(p: AlgorithmSelection, size: tuple[int, int]) -> None:
    """Raise ValueError if DIMES is selected and cannot bin images of this size (columns, rows)."""
    if any(name.startswith("dimes") for name in p.algorithms):
        check_binning(p.options.binned_size, size)


def run_estimator(
    create_estimator: Callable[[], VelocityEstimator],
    measurements: DescentMeasurements,
    triple: ImageTriple | None = _FIRST_TRIPLE,
) -> AlgorithmRun[VelocityEstimate]:
    """Run an estimator on a descent; the answer contains its span.

    Estimators that receive images one by one (streams), exports of the inputs and recorded answers use all images. All
    other estimators use the three images of `triple`. It is None if the descent has fewer than three images; the result
    for these estimators is then a failure with a message.
    """
    tags = measurements.tags_s

    def estimate(estimator: VelocityEstimator, inputs: DescentMeasurements) -> object:
        nonlocal tags
        if isinstance(estimator, StreamedEstimator | CaseExporter | RecordedAnswer):
            return estimator.estimate(inputs)
        if triple is None:
            raise ValueError(f"it needs three images, but the descent has {len(measurements.images)}")
        triple_inputs = inputs if len(measurements.images) == len(triple) else inputs.select(triple)
        tags = triple_inputs.tags_s
        return estimator.estimate(triple_inputs)

    return run_on_measurements(
        create_estimator, lambda answer: check_velocity_answer(answer, tags), measurements, estimate
    )


def check_velocity_answer(answer: object, tags_s: Sequence[float]) -> VelocityEstimate:
    """Validate the answer of an estimator, or those of a stream, which become the final answer's `after_images`.

    `tags_s` are the time tags of the images; missing time spans become the last interval. Raises AlgorithmError.
    """
    if not isinstance(answer, StreamAnswers):
        return check_and_set_span(answer, tags_s)
    after_images = tuple(
        None if estimate is None else check_and_set_span(estimate, tags_s[:number])
        for number, estimate in enumerate(answer.after_images, start=1)
    )
    return replace(check_and_set_span(answer.final, tags_s), after_images=after_images)


def check_last_interval(answer: object, measurements: DescentMeasurements) -> VelocityEstimate:
    """Validate an answer of a scenario that scores only the interval between the last two images.

    These scenarios have one true velocity per case: the mean over this interval. `DescentScenario` computes the truth
    of any span and does not call this function. Raises AlgorithmError for another span.
    """
    estimate = check_velocity_answer(answer, measurements.tags_s)
    if estimate.span_s not in (None, measurements.last_interval_s):
        raise AlgorithmError(
            Fault.BAD_ANSWER,
            f"span_s is {estimate.span_s}; allowed here: between the last two images, {measurements.last_interval_s}",
        )
    return estimate


def _answers_after_images(
    estimate: VelocityEstimate | None, truth: Callable[[Span], Horizontal]
) -> list[tuple[Span, Horizontal, Horizontal]]:
    """Return a stream's span, velocity and truth after each image, NaN without a velocity; empty without a stream."""
    no_answer = ((np.nan, np.nan), np.full(2, np.nan), np.full(2, np.nan))
    return [
        no_answer
        if answer is None or answer.velocity_m_s is None or answer.span_s is None
        else (answer.span_s, answer.velocity_m_s, truth(answer.span_s))
        for answer in (estimate.after_images if estimate is not None else ())
    ]


def stream_row(estimate: VelocityEstimate | None, truth: Callable[[Span], Horizontal]) -> dict[str, Scalar]:
    """Return the error columns of a stream after each image, NaN without a velocity; empty for other estimators.

    `images_before_answer` is the number of images before the first velocity, 0 if there is none.
    """
    errors = [float(np.hypot(*(velocity - true))) for _, velocity, true in _answers_after_images(estimate, truth)]
    if not errors:
        return {}
    first = next((number for number, error in enumerate(errors, start=1) if not np.isnan(error)), 0)
    row: dict[str, Scalar] = {"stream_images": len(errors), "images_before_answer": first}
    return row | {f"velocity_error_after_{number}_m_s": error for number, error in enumerate(errors, start=1)}


def velocity_row(name: str, estimate: Horizontal | None, truth: Horizontal) -> dict[str, Scalar]:
    """Return a velocity's error with the estimated and true velocity; NaN without an estimate."""
    estimate_or_nan = np.full(2, np.nan) if estimate is None else estimate
    error = estimate_or_nan - truth
    row: dict[str, Scalar] = {f"{name}_error_m_s": float(np.hypot(*error))}
    for kind, values in (("error", error), ("estimated", estimate_or_nan), ("true", truth)):
        row |= {f"{name}_{kind}_{axis}_m_s": float(value) for axis, value in zip("xy", values, strict=True)}
    return row


def consistency_row(estimate: VelocityEstimate | None, truth: Horizontal) -> dict[str, Scalar]:
    """Return the error relative to the reported covariance; empty without a covariance.

    `velocity_nees` is the squared error normalised by the covariance P, e' P^-1 e: for a consistent estimator with a
    normally distributed error it follows the chi-square distribution with 2 degrees of freedom (Bar-Shalom, Li &
    Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4.2).
    `velocity_normalised_x` and `_y` are the errors divided by their standard deviations: standard normal in that case.
    """
    if estimate is None or estimate.velocity_m_s is None or estimate.covariance_m2_s2 is None:
        return {}
    error, covariance = estimate.velocity_m_s - truth, estimate.covariance_m2_s2
    deviations = np.sqrt(np.diag(covariance))
    return {
        "velocity_sd_x_m_s": float(deviations[0]),
        "velocity_sd_y_m_s": float(deviations[1]),
        "velocity_correlation": float(covariance[0, 1] / (deviations[0] * deviations[1])),
        "velocity_normalised_x": float(error[0] / deviations[0]),
        "velocity_normalised_y": float(error[1] / deviations[1]),
        "velocity_nees": float(error @ np.linalg.solve(covariance, error)),
    }


def velocity_products(
    images: Sequence[UInt16[np.ndarray, "rows columns"]], estimate: VelocityEstimate | None, truth: Horizontal
) -> dict[str, object]:
    """Return the arrays for the figures of a case: images, DIMES' intermediate results, true and estimated velocity."""
    arrays: dict[str, object] = {f"image_{number}": counts for number, counts in enumerate(images, start=1)}
    if estimate is not None and isinstance(estimate.details, DimesDetails):
        arrays.update(dimes_products(estimate.details))
    arrays["velocity_true_m_s"] = truth
    if estimate is not None and estimate.velocity_m_s is not None:
        arrays["velocity_estimated_m_s"] = estimate.velocity_m_s
    return arrays


def stream_products(estimate: VelocityEstimate | None, truth: Callable[[Span], Horizontal]) -> dict[str, object]:
    """Return the answers of a stream for the figures of a case, with their truth; empty for other estimators.

    The arrays have one row per image: span, velocity and true velocity, NaN without a velocity.
    """
    names = ("after_spans_s", "after_velocities_m_s", "after_true_m_s")
    columns = zip(*_answers_after_images(estimate, truth), strict=True)
    return {name: np.array(values) for name, values in zip(names, columns, strict=False)}
