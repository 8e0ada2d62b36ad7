"""Functions for the tests of the conformance suite: run its checks, and write modules with defects."""

from pathlib import Path

import pytest

from marsyard.scenarios.conformance.candidates import Subject, determine_task, list_checks, run_check
from marsyard.scenarios.conformance.checks import Finding
from marsyard.scenarios.imports import import_object
from marsyard.scenarios.isolation.description import describe_factory
from marsyard.scenarios.isolation.remote import AlgorithmDescription


def run_suite(spec: str, *checks: str, task: str | None = None, limit_s: float = 60.0) -> dict[str, Finding]:
    """Run the given checks, or all checks, of an algorithm or part; return the findings by name of the check.

    The algorithm is described in this process, which takes less time than the start of a process.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("marsyard.scenarios.custom_algorithms.describe_in_process", describe_here)
        subject = Subject(spec, task or determine_task(spec), limit_s)
        names = [name for name, _ in list_checks(subject)]
        return {name: run_check(subject, names.index(name)) for name in (checks or names)}


def describe_here(spec: str) -> AlgorithmDescription:
    """Import an algorithm in this process, and describe it."""
    contents = describe_factory(import_object(spec))
    return AlgorithmDescription(**{**contents, "members": frozenset(contents["members"])})


def write_module(folder: Path, monkeypatch: pytest.MonkeyPatch, source: str) -> str:
    """Write a module, make its folder current and return its name, which is unique because Python caches modules."""
    name = f"bad_{abs(hash(source))}"
    (folder / f"{name}.py").write_text(source)
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    return name
