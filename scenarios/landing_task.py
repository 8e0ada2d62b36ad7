"""Task of the estimators of landing sites, and the format of their answers in tables.

Two systems evaluate this task, helicopter landings and recorded images. It is therefore a common module, as that of the
velocity estimators (ADR 39).
"""

from dataclasses import replace
from functools import partial

from marsyard.algorithms import exchange
from marsyard.algorithms.hda import HdaEstimator, HdaOptions
from marsyard.algorithms.hda.baselines import EssentialMatrixEstimator, SemiGlobalEstimator
from marsyard.algorithms.hda.options import IMPROVEMENTS
from marsyard.algorithms.interface import SiteEstimate, SiteEstimator, SiteOutcome
from marsyard.scenarios.offline_algorithms import AnswerFormat
from marsyard.scenarios.tasks import Task, variants
from marsyard.sim.measurements import LandingMeasurements


def _create_refusal(measurements: LandingMeasurements) -> SiteEstimate:
    """Create the refusal of a run that only exports its inputs: an algorithm without a map keeps the a-priori site."""
    return SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world)


#: Format of a table of landing sites.
SITE_FORMAT = AnswerFormat(
    form=exchange.SITE_FORM,
    numbers={"site_world": ("site_east_m", "site_north_m", "site_up_m")},
    required=("site_world",),
    create_refusal=_create_refusal,
)
LANDING: Task[SiteEstimator, HdaOptions] = Task(
    name="landing",
    noun="estimator of landing sites",
    methods=("estimate",),
    answers=(SiteEstimate, SiteOutcome),
    shipped={
        **variants("hda", HdaEstimator, IMPROVEMENTS),
        # the baselines replace stages of the improved algorithm
        "essential-matrix": lambda options: EssentialMatrixEstimator(replace(options, **IMPROVEMENTS)),
        "semi-global": lambda options: SemiGlobalEstimator(replace(options, **IMPROVEMENTS)),
    },
    executable=partial(exchange.ExecutableAlgorithm, requests=exchange.SITE_REQUESTS),
    options=HdaOptions,
    offline=SITE_FORMAT,
)
