"""Expected number of false PASSes among several requirements."""

from collections.abc import Sequence

from marsyard.reports.verdicts import ESTIMATE, Verdict
from marsyard.reports.wording import format_fraction


def multiplicity_text(verdicts: Sequence[Verdict]) -> str:
    """State the expected number of false PASSes and the joint confidence; empty for fewer than two requirements.

    A requirement that is not met gets PASS with a probability of at most 1 - confidence (consumer's risk). The expected
    number of false PASSes is at most the sum of these risks, for any dependence between the requirements; by Boole's
    inequality this sum also bounds the probability of at least one false PASS.
    """
    risks = [1.0 - item.confidence for item in verdicts if item.n and item.decide_by != ESTIMATE]
    # NaN and confidences outside of 0 to 1 are invalid requirements, whose verdict is not PASS
    risks = [risk for risk in risks if 0.0 < risk < 1.0]
    expected = sum(risks)
    if len(risks) < 2:
        return ""
    text = (
        f"{len(risks):,} requirements are decided at a confidence: if none is met, up to {expected:.2g} false "
        "PASSes are expected among them"
    )
    if expected >= 1.0 - 1e-9:
        return f"{text}. A single PASS of these is weak evidence."
    return f"{text}. Their PASSes hold together with at least {format_fraction(1.0 - expected)} confidence."
