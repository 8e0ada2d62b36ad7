"""Conformance suites: checks of an algorithm or a user-defined part against its protocol.

`inputs` synthesizes measurements without terrain or renderer; `checks` has the checks common to all suites;
`estimators`, `trackers` and `parts` add those of their protocols; `suite` selects them.
"""

from marsyard.scenarios.conformance.checks import Finding
from marsyard.scenarios.conformance.suite import EXAMINED, Subject, check_names, check_subject, run_check, task_of

__all__ = ["EXAMINED", "Finding", "Subject", "check_names", "check_subject", "run_check", "task_of"]
