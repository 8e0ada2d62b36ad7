"""Command `marsyard doctor`: check that a campaign can run on this machine, and print a remedy for each problem.

GL drivers and libraries can crash a process and are therefore tested in separate processes. At its top, this module
imports only the GL probe from Marsyard, so that the command also runs if other imports fail.
"""

import contextlib
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from ctypes.util import find_library
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from rich.console import Console
from rich.table import Table
from rich.text import Text

from marsyard import gl_probe

#: The parent folder of the package: the checkout, or site-packages.
ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "marsyard"
#: Import names of distributions whose import name differs from the distribution name.
IMPORT_NAMES = {
    "cyrk": "CyRK", "opencv-python-headless": "cv2", "pillow": "PIL", "pyrender2": "pyrender", "pyyaml": "yaml",
    "salib": "SALib", "scikit-learn": "sklearn",
}  # fmt: skip
#: Pairs of a required distribution and a conflicting distribution that overwrites its files.
CONFLICTS = (("pyrender2", "pyrender"), ("opencv-python-headless", "opencv-python"))
#: Debian packages of each GL backend; the preferred backend is first.
BACKENDS = {"osmesa": "libosmesa6 libgl1 libxrender1", "egl": "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libxrender1"}
#: The library that each backend loads, as in `marsyard.sim.render.backend`.
LIBRARIES = {"osmesa": "OSMesa", "egl": "EGL"}
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
REINSTALL = "make setup, or: pip install -c constraints.txt -e ."
BYTES_PER_MIB = 2**20
#: Free disk space, MiB: below the first value a check warns, below the second value it fails.
SUFFICIENT_DISK_MIB, MIN_DISK_MIB = 1024, 100
#: Memory that one worker process needs, MiB.
WORKER_MEMORY_MIB = 512
#: Time limit of a separate process, seconds.
PROBE_TIMEOUT_S = 30.0
#: Program that imports the modules in its arguments; it prints name and error message of each module as JSON.
_IMPORT_SCRIPT = """
import importlib, json, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
        message = ""
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
    print(json.dumps([name, message]), flush=True)
"""


class CheckResult(Enum):
    """Result of a check; its value is the colour on the terminal. Only FAIL prevents a campaign from running."""

    OK = "green"
    WARN = "yellow"
    FAIL = "red"


OK, WARN, FAIL = CheckResult


@dataclass(frozen=True)
class DoctorCheck:
    """Result of a check: name, finding, verdict, and the remedy of a problem (empty without a problem)."""

    name: str
    finding: str
    verdict: CheckResult = OK
    remedy: str = ""


def run(console: Console, *, as_json: bool = False) -> int:
    """Print all checks as a table or JSON; return 0 if a campaign can run on this machine, else 1."""
    checks, version = list(run_checks()), importlib.metadata.version("marsyard")
    failed_checks = [check.name for check in checks if check.verdict is FAIL]
    table = Table(title=f"Marsyard {version} in {ROOT}", title_justify="left")
    for heading in ("check", "finding", "verdict"):
        table.add_column(heading, overflow="fold")
    rows = []
    for check in checks:
        verdict = check.verdict.name.lower()
        rows.append({"check": check.name, "finding": check.finding, "verdict": verdict, "remedy": check.remedy})
        table.add_row(Text(check.name), Text(check.finding), Text(verdict, check.verdict.value))
    if as_json:
        summary = {"version": version, "root": str(ROOT), "can_run": not failed_checks, "checks": rows}
        console.print(json.dumps(summary, indent=2), markup=False, highlight=False, soft_wrap=True)
        return 1 if failed_checks else 0
    console.print(table)
    for check in checks:
        if check.remedy:
            console.print(Text(f"{check.name}: {check.remedy}"), soft_wrap=True)
    if failed_checks:
        console.print(Text(f"A campaign cannot run here: {', '.join(failed_checks)}.", "red"), soft_wrap=True)
        return 1
    console.print("A campaign can run here.")
    return 0


def run_checks() -> Iterator[DoctorCheck]:
    """Run all checks in the order of the table; slow checks run in parallel."""
    with ThreadPoolExecutor() as pool:
        rendering = {backend: pool.submit(probe_backend, backend) for backend in BACKENDS}
        names = [_import_name(canonicalize_name(requirement.name)) for requirement in _list_requirements()]
        # pyrender loads a GL library at import, which `probe_backend` tests
        imports = pool.submit(find_import_failures, [name for name in names if name != "pyrender"])
        yield check_python()
        yield check_optimisation(__debug__)
        yield from check_shadowing()
        yield from check_dependencies(imports.result())
        yield from check_rendering({backend: future.result() for backend, future in rendering.items()})
    yield check_numba_cache()
    yield from check_disk()
    yield check_machine()
    yield check_threads(os.environ, _count_cores())
    yield from check_systems()


def check_python() -> DoctorCheck:
    """Check the interpreter and the operating system."""
    finding = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    required = importlib.metadata.metadata("marsyard")["Requires-Python"]
    if platform.python_version() not in SpecifierSet(required):
        return DoctorCheck("python", f"{finding}; {required} is required", FAIL, f"install Python {required}")
    if sys.platform != "linux":
        return DoctorCheck("python", finding, WARN, "Marsyard is tested on Linux only")
    return DoctorCheck("python", finding)


def check_optimisation(has_assertions: bool) -> DoctorCheck:
    """Check that assertions are enabled: pyrender makes GL calls inside `assert` statements."""
    remedy = "run Python without -O and unset PYTHONOPTIMIZE"
    return (
        DoctorCheck("assertions", "on")
        if has_assertions
        else DoctorCheck("assertions", "off (python -O)", FAIL, remedy)
    )


def check_shadowing() -> Iterator[DoctorCheck]:
    """Check that Python imports this package, and that no distribution overwrites files of another distribution."""
    spec = importlib.util.find_spec(PACKAGE)
    origins = [] if spec is None else list(spec.submodule_search_locations or ())
    if spec is not None and spec.origin is not None:
        origins = [str(Path(spec.origin).parent)]
    origin = Path(origins[0]).resolve() if origins else None
    if origin != ROOT / PACKAGE:
        remedy = "uninstall that package, unset PYTHONPATH, or change to another folder; then " + REINSTALL
        yield DoctorCheck("package shadowing", f"another package is imported: {PACKAGE} from {origin}", FAIL, remedy)
    else:
        yield DoctorCheck("package shadowing", f"{PACKAGE} is imported from {origin}")
    owners = importlib.metadata.packages_distributions().get(PACKAGE, [])
    other_owners = sorted({canonicalize_name(owner) for owner in owners} - {"marsyard"})
    if other_owners:
        finding = f"{', '.join(other_owners)} also installs a package named {PACKAGE}"
        yield DoctorCheck("package names", finding, WARN, f"pip uninstall {' '.join(other_owners)}, then {REINSTALL}")
    for required, conflicting in CONFLICTS:
        if _find_version(conflicting) is not None:
            remedy = f"pip uninstall -y {conflicting} {required}, then {REINSTALL}"
            yield DoctorCheck("package names", f"{conflicting} overwrites files of {required}", FAIL, remedy)


def check_dependencies(failures: Mapping[str, str]) -> Iterator[DoctorCheck]:
    """Check the versions against pyproject.toml and constraints.txt; `failures` are those of `find_import_failures`."""
    pins = _read_pins()
    n_valid, pin_deviations = 0, []
    for requirement in _list_requirements():
        name = canonicalize_name(requirement.name)
        version = _find_version(name)
        if version is None:
            yield DoctorCheck(name, "not installed", FAIL, REINSTALL)
        elif not requirement.specifier.contains(version, prereleases=True):
            yield DoctorCheck(name, f"{version}, but {requirement} is required", FAIL, REINSTALL)
        elif (error := failures.get(_import_name(name))) is not None:
            yield DoctorCheck(name, f"{version} cannot be imported: {error}", FAIL, REINSTALL)
        else:
            n_valid += 1
            if pins.get(name, version) != version:
                pin_deviations.append(f"{name} {version} (pinned {pins[name]})")
    yield DoctorCheck("dependencies", f"{n_valid} distributions have supported versions and can be imported")
    if pin_deviations:
        yield DoctorCheck("pinned versions", ", ".join(pin_deviations), WARN, REINSTALL)


def find_import_failures(modules: Iterable[str]) -> dict[str, str]:
    """Import modules in a separate process; return the error messages by module."""
    remaining = list(modules)
    failures: dict[str, str] = {}
    while remaining:
        process = _run_python("-c", _IMPORT_SCRIPT, *remaining)
        results = [json.loads(line) for line in process.stdout.splitlines()]
        failures |= {name: error for name, error in results if error}
        remaining = remaining[len(results) :]
        if remaining:  # the first remaining module crashed the process
            failures[remaining.pop(0)] = _failure_reason(process)
    return failures


def _list_requirements() -> list[Requirement]:
    """List the distributions that Marsyard requires on this platform, without extras."""
    requirements = [Requirement(text) for text in importlib.metadata.requires("marsyard") or []]
    return [item for item in requirements if item.marker is None or item.marker.evaluate({"extra": ""})]


def _read_pins() -> dict[str, str]:
    """Return the versions of constraints.txt by canonical name; empty if Marsyard is not a checkout."""
    file = ROOT / "constraints.txt"
    lines = file.read_text().split() if file.is_file() else []
    return {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}


def _import_name(distribution: str) -> str:
    return IMPORT_NAMES.get(distribution, distribution.replace("-", "_"))


def _find_version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True)
class Probe:
    """Result of `gl_probe.probe` for one backend; `measurements` are None if it failed, for the reason `error`."""

    measurements: Mapping[str, Any] | None
    error: str = ""


def probe_backend(backend: str) -> Probe:
    """Render a test frame with a backend in a separate process."""
    process = _run_python("-P", str(Path(gl_probe.__file__)), backend)
    try:
        return Probe(json.loads(process.stdout.splitlines()[-1]))
    except (IndexError, ValueError):
        return Probe(None, _failure_reason(process))


def check_rendering(probes: Mapping[str, Probe]) -> Iterator[DoctorCheck]:
    """Check each backend, and the backend that a campaign would use."""
    checks = {backend: _check_backend(backend, probe) for backend, probe in probes.items()}
    yield from checks.values()
    working = [backend for backend, check in checks.items() if check.verdict is OK]
    selected_backend = _select_backend()
    if selected_backend not in BACKENDS:
        finding = f"MARSYARD_GL is '{selected_backend}'; allowed: {', '.join(BACKENDS)}"
        yield DoctorCheck("GL backend in use", finding, FAIL, "unset MARSYARD_GL")
    elif selected_backend in working:
        yield DoctorCheck("GL backend in use", selected_backend)
    elif working:
        remedy = f"export MARSYARD_GL={working[0]}, or install {BACKENDS[selected_backend]}"
        yield DoctorCheck("GL backend in use", f"{selected_backend} does not work; {working[0]} works", WARN, remedy)
    else:
        yield DoctorCheck(
            "GL backend in use", "no backend works", FAIL, f"sudo apt-get install {BACKENDS[selected_backend]}"
        )


def _select_backend() -> str:
    """Return the backend of a campaign: that of MARSYARD_GL, otherwise the first one that is installed.

    It is that of `marsyard.sim.render.backend.default_backend`; an invalid name is returned, too.
    """
    installed = (backend for backend in BACKENDS if find_library(LIBRARIES[backend]))
    return os.environ.get("MARSYARD_GL", "").lower() or next(installed, next(iter(BACKENDS)))


def _check_backend(backend: str, probe: Probe) -> DoctorCheck:
    name = f"GL: {backend}"
    remedy = f"sudo apt-get install {BACKENDS[backend]}"
    if probe.measurements is None:
        return DoctorCheck(name, probe.error, WARN, remedy)
    values = probe.measurements
    finding = f"{values['renderer']}, {values['version']}"
    error_m, offset = values["depth_error_m"], values["offset_px"]
    if not values["has_colour"] or error_m > gl_probe.DEPTH_TOLERANCE_M:
        problem = f"; wrong image: depth error of the test plane {error_m:.3g} m"
        return DoctorCheck(name, finding + problem, WARN, "use the other backend, or another driver")
    finding += f"; depth error {error_m * 1e3:.2g} mm at {gl_probe.DISTANCE_M:.0f} m"
    if max(map(abs, offset)) > gl_probe.OFFSET_TOLERANCE_PX:
        pixels = f"({offset[0]:+.3f}, {offset[1]:+.3f}) px"
        finding += f"; pyrender samples depth {pixels} from the pixel centre; Marsyard at the centre"
    return DoctorCheck(name, finding)


def check_numba_cache() -> DoctorCheck:
    """Check that compiled kernels can be cached; without a cache, each process compiles them again."""
    with contextlib.suppress(ImportError):
        importlib.import_module("marsyard.sim")  # sets NUMBA_CACHE_DIR, unless the user has set it
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", Path.home() / ".cache" / "numba"))
    if _is_writable(folder):
        return DoctorCheck("numba cache", f"{folder} is writable")
    remedy = "export NUMBA_CACHE_DIR=FOLDER, where FOLDER is writable"
    return DoctorCheck("numba cache", f"cannot write to {folder}", WARN, remedy)


def check_disk() -> Iterator[DoctorCheck]:
    """Check the disk space for campaigns and for terrains."""
    yield _check_disk_space("disk, this folder", Path.cwd(), "free disk space, or choose another disk with --out")
    remedy = "export MARSYARD_CACHE=FOLDER, where FOLDER is writable and has free space"
    try:
        from marsyard.sim.cache import cache_directory

        cache = cache_directory("terrain")
    except (ImportError, OSError) as error:
        yield DoctorCheck("disk, cache", str(error), FAIL, remedy)
        return
    yield _check_disk_space("disk, cache", cache, remedy)


def _check_disk_space(name: str, folder: Path, remedy: str) -> DoctorCheck:
    free = shutil.disk_usage(folder).free // BYTES_PER_MIB
    if not _is_writable(folder):
        return DoctorCheck(name, f"cannot write to {folder}", FAIL, remedy)
    verdict = OK if free >= SUFFICIENT_DISK_MIB else FAIL if free < MIN_DISK_MIB else WARN
    return DoctorCheck(name, f"{free} MiB free in {folder}", verdict, "" if verdict is OK else remedy)


def check_machine() -> DoctorCheck:
    """Check cores and memory of the machine or of its control group."""
    cores, limits = _count_cores(), [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    group_limit = Path("/sys/fs/cgroup/memory.max")
    if group_limit.is_file() and (text := group_limit.read_text().strip()).isdigit():
        limits.append(int(text))
    memory = min(limits) // BYTES_PER_MIB
    finding = f"{cores} cores, {memory} MiB of memory"
    if memory < WORKER_MEMORY_MIB * cores:
        return DoctorCheck("cores and memory", finding, WARN, f"run with --jobs {max(1, memory // WORKER_MEMORY_MIB)}")
    return DoctorCheck("cores and memory", finding)


def check_threads(environment: Mapping[str, str], cores: int) -> DoctorCheck:
    """Check the thread counts in environment variables; more threads than cores slow down the workers."""
    counts = {name: environment[name] for name in THREAD_VARIABLES if environment.get(name)}
    finding = ", ".join(f"{name}={value}" for name, value in counts.items()) or "not set; the libraries decide"
    if any(not value.isdigit() or int(value) > cores for value in counts.values()):
        return DoctorCheck("threads", finding, WARN, f"unset {' '.join(counts)}")
    return DoctorCheck("threads", finding)


def check_systems() -> Iterator[DoctorCheck]:
    """Check the definitions of the systems under test, built in and plug-ins."""
    try:
        from marsyard.scenarios.systems import registry

        systems = registry()
    except ImportError as error:
        yield DoctorCheck("systems", f"cannot be read: {error}", FAIL, REINSTALL)
        return
    plugins = ", ".join(system.name for system in systems.plugins)
    yield DoctorCheck("systems", f"{len(systems.own)} built in; plug-ins: {plugins or 'none'}")
    for problem in systems.problems:
        yield DoctorCheck("systems", problem, WARN, "correct or uninstall the package that defines the system")


def _count_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _is_writable(folder: Path) -> bool:
    """Whether a file can be created in a folder; a missing folder is created."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with these arguments in a separate process; status -1 after a timeout."""
    command = [sys.executable, *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, check=False)  # noqa: S603
    except subprocess.TimeoutExpired as timeout:
        output = timeout.stdout.decode() if isinstance(timeout.stdout, bytes) else ""
        return subprocess.CompletedProcess(command, -1, output, f"no answer within {PROBE_TIMEOUT_S:.0f} s")


def _failure_reason(process: subprocess.CompletedProcess[str]) -> str:
    """Return the last line of the standard error, or the exit status without output."""
    lines = [line.strip() for line in process.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"the process ended with status {process.returncode}"
