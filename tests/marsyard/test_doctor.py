"""Tests of `marsyard doctor`: checks of the installation, their verdicts and remedies."""

import importlib.metadata
import importlib.util
import io
import json
import os
import sys
import tomllib
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from rich.console import Console

from marsyard import doctor, gl_probe
from marsyard.doctor import CheckResult, DoctorCheck, Probe
from marsyard.sim.render import backend

#: Results of a rendering test with an OpenGL backend that works, and with one that is not installed.
WORKING_BACKEND = Probe(
    {"renderer": "r", "version": "v", "depth_error_m": 1e-5, "offset_px": [0.0, 0.0], "has_colour": True}
)
ABSENT_BACKEND = Probe(None, "ImportError: no library")


def run_doctor(*, as_json: bool = False) -> tuple[int, str]:
    console = Console(file=io.StringIO(), width=200)
    status = doctor.run(console, as_json=as_json)
    assert isinstance(console.file, io.StringIO)
    return status, console.file.getvalue()


@pytest.fixture
def set_check(monkeypatch: pytest.MonkeyPatch) -> Callable[[DoctorCheck], None]:
    """Return a function that replaces all checks by one."""
    return lambda check: monkeypatch.setattr(doctor, "run_checks", lambda: iter([check]))


@pytest.mark.slow
def test_all_checks_pass_on_this_machine() -> None:
    status, text = run_doctor()
    assert status == 0, text
    assert "depth error" in text
    assert "A campaign can run here." in text


@pytest.mark.parametrize(("verdict", "status"), [(CheckResult.OK, 0), (CheckResult.WARN, 0), (CheckResult.FAIL, 1)])
def test_only_failures_change_the_exit_status(
    set_check: Callable[[DoctorCheck], None], verdict: CheckResult, status: int
) -> None:
    set_check(DoctorCheck("disk", "2 GB [free]", verdict, "see the manual"))
    exit_status, text = run_doctor()
    assert exit_status == status
    assert "2 GB [free]" in text
    assert "disk: see the manual" in text
    exit_status, text = run_doctor(as_json=True)
    report = json.loads(text)
    assert (exit_status, report["can_run"]) == (status, status == 0)
    assert report["checks"] == [
        {"check": "disk", "finding": "2 GB [free]", "verdict": verdict.name.lower(), "remedy": "see the manual"}
    ]


def test_depth_error_of_a_plane_is_small() -> None:
    # the backend of this test process
    probe = doctor.probe_backend(os.environ["MARSYARD_GL"])
    assert probe.measurements is not None, probe.error
    # a 24-bit depth buffer between 40 and 400 m resolves 1e-5 m at 100 m, 2e-4 m at 400 m
    assert probe.measurements["depth_error_m"] < 2e-4


def test_missing_backend_has_an_error_message() -> None:
    probe = doctor.probe_backend("missing_module")
    assert probe.measurements is None
    assert probe.error


@pytest.mark.parametrize(
    ("osmesa", "egl", "backend", "verdict", "remedy"),
    [
        (WORKING_BACKEND, WORKING_BACKEND, "osmesa", CheckResult.OK, ""),
        (WORKING_BACKEND, ABSENT_BACKEND, "osmesa", CheckResult.OK, ""),
        (ABSENT_BACKEND, WORKING_BACKEND, "egl", CheckResult.OK, ""),
        (ABSENT_BACKEND, WORKING_BACKEND, "osmesa", CheckResult.WARN, "export MARSYARD_GL=egl"),
        (ABSENT_BACKEND, ABSENT_BACKEND, "osmesa", CheckResult.FAIL, "apt-get install libosmesa6"),
        (WORKING_BACKEND, WORKING_BACKEND, "vulkan", CheckResult.FAIL, "unset MARSYARD_GL"),
    ],
)
def test_verdict_follows_the_selected_backend(
    monkeypatch: pytest.MonkeyPatch, osmesa: Probe, egl: Probe, backend: str, verdict: CheckResult, remedy: str
) -> None:
    monkeypatch.setenv("MARSYARD_GL", backend)
    *_, selection = doctor.check_rendering({"osmesa": osmesa, "egl": egl})
    assert selection.verdict is verdict
    assert remedy in selection.remedy


@pytest.mark.parametrize("installed", [("OSMesa", "EGL"), ("OSMesa",), ("EGL",), ()])
@pytest.mark.parametrize("variable", ["", None])
def test_without_variable_the_first_installed_backend_is_checked(
    monkeypatch: pytest.MonkeyPatch, installed: tuple[str, ...], variable: str | None
) -> None:
    """The doctor checks the backend that campaigns use; a machine with EGL only needs no variable."""
    monkeypatch.delenv("MARSYARD_GL")
    if variable is not None:
        monkeypatch.setenv("MARSYARD_GL", variable)
    for module in (doctor, backend):
        monkeypatch.setattr(module, "find_library", lambda name: name if name in installed else None)
    probes = {
        name: WORKING_BACKEND if library in installed else ABSENT_BACKEND for name, library in doctor.LIBRARIES.items()
    }
    *_, selection = doctor.check_rendering(probes)
    if installed:
        assert (selection.verdict, selection.finding) == (CheckResult.OK, backend.default_backend())
    else:
        assert selection.verdict is CheckResult.FAIL


def test_backend_with_wrong_depth_fails() -> None:
    assert WORKING_BACKEND.measurements is not None
    inaccurate = Probe({**WORKING_BACKEND.measurements, "depth_error_m": 0.5})
    first, *_, selection = doctor.check_rendering({"osmesa": inaccurate})
    assert first.verdict is CheckResult.WARN
    assert selection.verdict is CheckResult.FAIL


@pytest.mark.parametrize("has_init", [True, False])
def test_package_from_another_folder_is_reported(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, has_init: bool
) -> None:
    spec = ModuleSpec("marsyard", None, origin=str(tmp_path / "marsyard" / "__init__.py") if has_init else None)
    spec.submodule_search_locations = [str(tmp_path / "marsyard")]
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec)
    check = next(doctor.check_shadowing())
    assert check.verdict is CheckResult.FAIL
    assert f"marsyard from {tmp_path / 'marsyard'}" in check.finding


def test_conflicting_packages_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: {"marsyard": ["Sim_Games", "marsyard"]})
    monkeypatch.setattr(doctor, "_find_version", lambda _: "0.1.45")
    _, conflict, *others = doctor.check_shadowing()
    assert "sim-games also installs a package named marsyard" in conflict.finding
    assert any("pip uninstall -y pyrender pyrender2" in other.remedy for other in others)


def test_dependencies_are_checked_by_import_name() -> None:
    # installed metadata may be older than the file in a development environment
    requirements = tomllib.loads((doctor.ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    modules = [doctor._import_name(canonicalize_name(Requirement(requirement).name)) for requirement in requirements]
    assert [module for module in modules if importlib.util.find_spec(module) is None] == []


def test_missing_old_and_broken_dependencies_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    requirements = ["numpy>=2.2", "scipy>=1.17", "joblib>=1.5", "dask>=2025.9; extra == 'dask'", "rich>=14"]
    versions = {"scipy": "1.9", "joblib": "1.6.0", "rich": "14.0"}
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: requirements)
    monkeypatch.setattr(doctor, "_find_version", versions.get)
    monkeypatch.setattr(doctor, "_read_pins", lambda: {"rich": "15.0.0"})
    checks = {check.name: check for check in doctor.check_dependencies({"joblib": "OSError: truncated"})}
    assert {name: check.verdict for name, check in checks.items()} == {
        "numpy": CheckResult.FAIL,
        "scipy": CheckResult.FAIL,
        "joblib": CheckResult.FAIL,
        "dependencies": CheckResult.OK,
        "pinned versions": CheckResult.WARN,
    }
    assert "truncated" in checks["joblib"].finding
    assert "rich 14.0 (pinned 15.0.0)" in checks["pinned versions"].finding


def test_module_that_exits_does_not_hide_other_failures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "exiting.py").write_text("import os; os._exit(3)")
    (tmp_path / "faulty.py").write_text("import missing_module")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    failures = doctor.find_import_failures(["json", "exiting", "faulty", "math"])
    assert failures == {
        "exiting": "the process ended with status 3",
        "faulty": "ModuleNotFoundError: No module named 'missing_module'",
    }


def test_python_without_assertions_fails() -> None:
    assert doctor.check_optimisation(has_assertions=False).verdict is CheckResult.FAIL


def test_more_threads_than_cores_give_a_warning() -> None:
    assert doctor.check_threads({"OMP_NUM_THREADS": "64"}, cores=2).verdict is CheckResult.WARN
    assert doctor.check_threads({"OMP_NUM_THREADS": "1"}, cores=2).verdict is CheckResult.OK


def test_unwritable_caches_are_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(file / "numba"))
    monkeypatch.setenv("MARSYARD_CACHE", str(file))
    assert doctor.check_numba_cache().verdict is CheckResult.WARN
    assert [check.verdict for check in doctor.check_disk()] == [CheckResult.OK, CheckResult.FAIL]


def test_probe_imports_only_the_standard_library() -> None:
    source = Path(str(gl_probe.__file__)).read_text()
    packages = [line.split()[1].split(".")[0] for line in source.splitlines() if line.startswith(("import ", "from "))]
    assert set(packages) <= set(sys.stdlib_module_names)
