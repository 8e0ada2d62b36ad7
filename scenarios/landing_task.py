"""Task of the estimators of landing sites, and the format of their answers in tables."""

from dataclasses import replace
from functools import partial

from marsyard.algorithms import exchange
from marsyard.algorithms.hda import HdaEstimator, HdaOptions
from marsyard.algorithms.hda.baselines import EssentialMatrixEstimator, SemiGlobalEstimator
from marsyard.algorithms.hda.options import IMPROVEMENTS
from marsyard.algorithms.interface import SiteEstimate, SiteEstimator, SiteOutcome
from marsyard.scenarios.offline_algorithms import AnswerFormat
from marsyard.scenarios.tasks import Task, variants

#: Format of a table of landing sites.
SITE_FORMAT = AnswerFormat(
    form=exchange.SITE_FORM,
    numbers={"site_world": ("site_east_m", "site_north_m", "site_up_m")},
    required=("site_world",),
    create_empty=lambda measurements: SiteEstimate(SiteOutcome.NO_STRUCTURE, measurements.apriori_site_world),
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
