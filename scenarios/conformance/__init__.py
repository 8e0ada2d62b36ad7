"""The protocols' suite: what an algorithm or a part must do, and must not, whatever it is given.

Read it in this order: `surfaces` and `inputs` make measurements without terrain or renderer; `findings` is what a check
says; `estimators`, `streams`, `trackers` and `parts` hold the checks, `process` what some of them watch; `suite` puts
them together.
"""

from marsyard.scenarios.conformance.findings import Finding
from marsyard.scenarios.conformance.suite import EXAMINED, Subject, check_names, check_subject, run_check, task_of

__all__ = ["EXAMINED", "Finding", "Subject", "check_names", "check_subject", "run_check", "task_of"]
