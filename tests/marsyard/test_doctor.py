"""The doctor finds what is sound sound, and names what is amiss with its remedy."""

from __future__ import annotations

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
from marsyard.doctor import Check, Probe, Verdict

SOUND = Probe({"renderer": "r", "version": "v", "depth_error_m": 1e-5, "offset_px": [0.0, 0.0], "lit": True})
ABSENT = Probe(None, "ImportError: no library")


def examined(*, as_json: bool = False) -> tuple[int, str]:
    console = Console(file=io.StringIO(), width=200)
    status = doctor.run(console, as_json=as_json)
    assert isinstance(console.file, io.StringIO)
    return status, console.file.getvalue()


@pytest.fixture
def one_check(monkeypatch: pytest.MonkeyPatch) -> Callable[[Check], None]:
    return lambda check: monkeypatch.setattr(doctor, "examine", lambda: iter([check]))


def test_this_machine_is_sound() -> None:
    status, text = examined()
    assert status == 0, text
    assert "depth right to" in text
    assert "A campaign can run here." in text


@pytest.mark.parametrize(("verdict", "status"), [(Verdict.OK, 0), (Verdict.WARN, 0), (Verdict.FAIL, 1)])
def test_only_failures_count(one_check: Callable[[Check], None], verdict: Verdict, status: int) -> None:
    one_check(Check("teeth", "three [left]", verdict, "see a dentist"))
    got, text = examined()
    assert got == status
    assert "three [left]" in text
    assert "teeth: see a dentist" in text
    got, text = examined(as_json=True)
    reported = json.loads(text)
    assert (got, reported["can_run"]) == (status, status == 0)
    assert reported["checks"] == [
        {"check": "teeth", "finding": "three [left]", "verdict": verdict.name.lower(), "remedy": "see a dentist"}
    ]


def test_depth_of_a_frame_is_measured_against_the_plane() -> None:
    # the backend that the tests themselves render with
    probe = doctor.probe_backend(os.environ["MARSYARD_GL"])
    assert probe.measured is not None, probe.fault
    # a 24-bit depth buffer between 40 and 400 m resolves 1e-5 m at 100 m, 2e-4 m at 400 m
    assert probe.measured["depth_error_m"] < 2e-4


def test_a_backend_that_does_not_exist_has_a_reason() -> None:
    probe = doctor.probe_backend("nonesuch")
    assert probe.measured is None
    assert probe.fault


@pytest.mark.parametrize(
    ("osmesa", "egl", "wanted", "verdict", "remedy"),
    [
        (SOUND, SOUND, "osmesa", Verdict.OK, ""),
        (SOUND, ABSENT, "osmesa", Verdict.OK, ""),
        (ABSENT, SOUND, "egl", Verdict.OK, ""),
        (ABSENT, SOUND, "osmesa", Verdict.WARN, "export MARSYARD_GL=egl"),
        (ABSENT, ABSENT, "osmesa", Verdict.FAIL, "apt-get install libosmesa6"),
        (SOUND, SOUND, "vulkan", Verdict.FAIL, "unset MARSYARD_GL"),
    ],
)
def test_the_backend_in_use(
    monkeypatch: pytest.MonkeyPatch, osmesa: Probe, egl: Probe, wanted: str, verdict: Verdict, remedy: str
) -> None:
    monkeypatch.setenv("MARSYARD_GL", wanted)
    *_, last = doctor.check_rendering({"osmesa": osmesa, "egl": egl})
    assert last.verdict is verdict
    assert remedy in last.remedy


def test_a_wrong_picture_is_not_a_working_backend() -> None:
    assert SOUND.measured is not None
    wrong = Probe({**SOUND.measured, "depth_error_m": 0.5})
    first, *_, last = doctor.check_rendering({"osmesa": wrong})
    assert first.verdict is Verdict.WARN
    assert last.verdict is Verdict.FAIL


def test_a_package_from_elsewhere_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    genuine = importlib.util.find_spec

    def found(name: str) -> ModuleSpec | None:
        origin = str(tmp_path / "marsyard" / "__init__.py")
        return ModuleSpec(name, None, origin=origin) if name == "marsyard" else genuine(name)

    monkeypatch.setattr(importlib.util, "find_spec", found)
    check = next(doctor.check_shadowing())
    assert check.verdict is Verdict.FAIL
    assert f"marsyard from {tmp_path / 'marsyard'}" in check.finding


def test_a_folder_without_init_counts_as_shadow(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "marsyard").mkdir()
    spec = ModuleSpec("marsyard", None, is_package=True)
    spec.submodule_search_locations = [str(tmp_path / "marsyard")]
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: spec)
    assert str(tmp_path / "marsyard") in next(doctor.check_shadowing()).finding


def test_other_owners_of_our_names_and_rivals_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "packages_distributions", lambda: {"marsyard": ["Sim_Games", "marsyard"]})
    monkeypatch.setattr(doctor, "_version", lambda _: "0.1.45")
    _, stranger, *rivals = doctor.check_shadowing()
    assert "sim-games also installs a package named marsyard" in stranger.finding
    assert any("pip uninstall -y pyrender pyrender2" in rival.remedy for rival in rivals)


def test_every_dependency_is_looked_for_under_the_name_it_imports_by() -> None:
    # From the file and not the installed metadata, which in a developer's environment may be older than the file.
    needs = tomllib.loads((doctor.ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    modules = [doctor._module(canonicalize_name(Requirement(need).name)) for need in needs]
    assert [module for module in modules if importlib.util.find_spec(module) is None] == []


def test_dependencies_that_are_absent_old_or_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    needs = ["numpy>=2.2", "scipy>=1.17", "joblib>=1.5", "dask>=2025.9; extra == 'dask'", "rich>=14"]
    versions = {"scipy": "1.9", "joblib": "1.6.0", "rich": "14.0"}
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: needs)
    monkeypatch.setattr(doctor, "_version", versions.get)
    monkeypatch.setattr(doctor, "_pins", lambda: {"rich": "15.0.0"})
    checks = {check.name: check for check in doctor.check_dependencies({"joblib": "OSError: truncated"})}
    assert {name: check.verdict for name, check in checks.items()} == {
        "numpy": Verdict.FAIL,
        "scipy": Verdict.FAIL,
        "joblib": Verdict.FAIL,
        "dependencies": Verdict.OK,
        "pinned versions": Verdict.WARN,
    }
    assert "truncated" in checks["joblib"].finding
    assert "rich 14.0 (pinned 15.0.0)" in checks["pinned versions"].finding


def test_a_module_that_ends_the_process_does_not_hide_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "deadly.py").write_text("import os; os._exit(3)")
    (tmp_path / "faulty.py").write_text("import nonesuch")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    failures = doctor.import_failures(["json", "deadly", "faulty", "math"])
    assert failures == {
        "deadly": "the process ended with status 3",
        "faulty": "ModuleNotFoundError: No module named 'nonesuch'",
    }


def test_python_without_assertions_is_refused() -> None:
    assert doctor.check_optimisation(assertions=False).verdict is Verdict.FAIL


def test_more_threads_than_cores_are_a_warning() -> None:
    assert doctor.check_threads({"OMP_NUM_THREADS": "64"}, cores=2).verdict is Verdict.WARN
    assert doctor.check_threads({"OMP_NUM_THREADS": "1"}, cores=2).verdict is Verdict.OK


def test_a_cache_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    occupied = tmp_path / "file"
    occupied.touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(occupied / "numba"))
    monkeypatch.setenv("MARSYARD_CACHE", str(occupied))
    assert doctor.check_numba_cache().verdict is Verdict.WARN
    assert [check.verdict for check in doctor.check_disk()] == [Verdict.OK, Verdict.FAIL]


def test_the_probe_stands_alone() -> None:
    source = Path(str(gl_probe.__file__)).read_text()
    packages = [line.split()[1].split(".")[0] for line in source.splitlines() if line.startswith(("import ", "from "))]
    assert set(packages) <= set(sys.stdlib_module_names)
