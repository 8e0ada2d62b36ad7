"""The protocols' suite: what an algorithm or a part must do, and must not, whatever it is given.

Read it in this order: `surfaces` and `inputs` make measurements without terrain or renderer; `checks` has a check, its
finding and the checks that all suites share; `estimators`, `trackers` and `parts` hold the others; `suite` puts them
together.
"""

from marsyard.scenarios.conformance.checks import Finding
from marsyard.scenarios.conformance.suite import EXAMINED, Subject, check_names, check_subject, run_check, task_of

__all__ = ["EXAMINED", "Finding", "Subject", "check_names", "check_subject", "run_check", "task_of"]
