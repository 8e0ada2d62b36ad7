"""Conformance suites: checks of an algorithm or a user-defined part against its protocol.

`inputs` synthesizes measurements without terrain or renderer; `checks` contains the checks common to all suites;
`estimators`, `trackers` and `parts` add the checks of their protocols. The tasks of further systems define their own
suites (`marsyard.scenarios.tasks.Task.suite`). `candidates` selects the suite of an algorithm or part, and runs it.
"""
