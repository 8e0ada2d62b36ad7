"""Velocity estimators: their task, the format of their answers in tables, and their runs with checked answers.

The answer of a velocity estimator is a mean velocity over a span: the interval between two time tags.
`marsyard.scenarios.velocity_score` compares it with the truth.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from marsyard.algorithms import exchange
from marsyard.algorithms.answers import check_and_set_span
from marsyard.algorithms.dimes import DimesEstimator, DimesOptions
from marsyard.algorithms.dimes.baselines import HomographyEstimator, PhaseCorrelationEstimator
from marsyard.algorithms.dimes.options import IMPROVEMENTS
from marsyard.algorithms.dimes.views import check_binning
from marsyard.algorithms.faults import AlgorithmError, Fault
from marsyard.algorithms.interface import VelocityEstimate, VelocityEstimator, VelocityOutcome
from marsyard.scenarios.algorithm_run import AlgorithmRun, run_on_measurements
from marsyard.scenarios.algorithm_selection import AlgorithmSelection
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
    create_refusal=lambda _: VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None),
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
    tags = measurements.tags_s  # of the images that the estimator receives, to which its answer refers

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
