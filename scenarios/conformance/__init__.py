"""The protocols' suite: what an algorithm must do, and must not, whatever pictures it is given.

Read it in this order: `surfaces` and `inputs` make measurements without terrain or renderer; `findings` is what a check
says; `estimators`, `streams` and `trackers` hold the checks, `process` what some of them watch; `suite` puts them
together.
"""

from scenarios.conformance.findings import Finding
from scenarios.conformance.suite import Subject, check_names, run_check, task_of

__all__ = ["Finding", "Subject", "check_names", "run_check", "task_of"]
