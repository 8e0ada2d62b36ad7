"""Conformance suites: checks of an algorithm or a user-defined part against its protocol.

`inputs` synthesizes measurements without terrain or renderer; `checks` has the checks common to all suites;
`estimators`, `trackers` and `parts` add those of their protocols; `suite` selects them.
"""

from marsyard.scenarios.conformance.checks import Finding
from marsyard.scenarios.conformance.suite import (
    SUBJECT_KINDS,
    Subject,
    check_names,
    check_subject,
    determine_task,
    run_check,
)

__all__ = ["SUBJECT_KINDS", "Finding", "Subject", "check_names", "check_subject", "determine_task", "run_check"]
