"""``marsyard doctor``: check that a campaign can run on this machine, and name the remedy of each fault.

Drivers and libraries, which may crash the process, are tested in separate processes. Of Marsyard only the probe is
imported at first: users run this command when imports fail.
"""

from __future__ import annotations

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

#: The folder that holds the package: the checkout, or site-packages.
ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "marsyard"
#: Distributions that import under another name than their own.
MODULES = {"opencv-python-headless": "cv2", "pyrender2": "pyrender", "pyyaml": "yaml"}
#: Distributions that write into the same folder as one of ours, ours first.
RIVALS = (("pyrender2", "pyrender"), ("opencv-python-headless", "opencv-python"))
#: The GL backends, the preferred one first, and their Debian packages.
BACKENDS = {"osmesa": "libosmesa6 libgl1 libxrender1", "egl": "libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libxrender1"}
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
REINSTALL = "make setup, or: pip install -c constraints.txt -e ."
MEBI = 2**20
PROBE_LIMIT_S = 30.0


class Verdict(Enum):
    """Result of a check; only FAIL prevents a campaign from running."""

    OK = "green"
    WARN = "yellow"
    FAIL = "red"


@dataclass(frozen=True)
class Check:
    """One check: its name, the finding, and the remedy of a fault."""

    name: str
    finding: str
    verdict: Verdict = Verdict.OK
    remedy: str = ""


def run(console: Console, *, as_json: bool = False) -> int:
    """Print all checks as a table or JSON; return 0 if a campaign can run here, else 1."""
    checks, version = list(examine()), importlib.metadata.version("marsyard")
    failed = [check.name for check in checks if check.verdict is Verdict.FAIL]
    table = Table(title=f"Marsyard {version} in {ROOT}", title_justify="left")
    for heading in ("check", "found", "verdict"):
        table.add_column(heading, overflow="fold")
    rows = []
    for check in checks:
        word = check.verdict.name.lower()
        rows.append({"check": check.name, "finding": check.finding, "verdict": word, "remedy": check.remedy})
        table.add_row(Text(check.name), Text(check.finding), Text(word, check.verdict.value))
    if as_json:
        summary = {"version": version, "root": str(ROOT), "can_run": not failed, "checks": rows}
        console.print(json.dumps(summary, indent=2), markup=False, highlight=False, soft_wrap=True)
        return 1 if failed else 0
    console.print(table)
    for check in checks:
        if check.remedy:
            console.print(Text(f"{check.name}: {check.remedy}"), soft_wrap=True)
    if failed:
        console.print(Text(f"A campaign cannot run here: {', '.join(failed)}.", "red"), soft_wrap=True)
        return 1
    console.print("A campaign can run here.")
    return 0


def examine() -> Iterator[Check]:
    """Run all checks, in the order of the table; the slow ones run in parallel."""
    with ThreadPoolExecutor() as pool:
        rendering = {backend: pool.submit(probe_backend, backend) for backend in BACKENDS}
        names = [_module(canonicalize_name(requirement.name)) for requirement in _requirements()]
        # pyrender loads a GL library at import, which `probe_backend` tests
        imports = pool.submit(import_failures, [name for name in names if name != "pyrender"])
        yield check_python()
        yield check_optimisation(__debug__)
        yield from check_shadowing()
        yield from check_dependencies(imports.result())
        yield from check_rendering({backend: future.result() for backend, future in rendering.items()})
    yield check_numba_cache()
    yield from check_disk()
    yield check_machine()
    yield check_threads(os.environ, _cores())
    yield from check_systems()


def check_python() -> Check:
    """Check the interpreter and the operating system."""
    finding = f"Python {platform.python_version()}, {platform.system()} {platform.machine()}"
    wanted = importlib.metadata.metadata("marsyard")["Requires-Python"]
    if platform.python_version() not in SpecifierSet(wanted):
        return Check("python", f"{finding}; {wanted} is needed", Verdict.FAIL, f"install Python {wanted}")
    if sys.platform != "linux":
        return Check("python", finding, Verdict.WARN, "Marsyard is tested on Linux only")
    return Check("python", finding)


def check_optimisation(assertions: bool) -> Check:
    """Check that `assert` statements run: pyrender makes GL calls inside them."""
    remedy = "run Python without -O and unset PYTHONOPTIMIZE"
    return Check("assertions", "on") if assertions else Check("assertions", "off (python -O)", Verdict.FAIL, remedy)


def check_shadowing() -> Iterator[Check]:
    """Check that Python imports this package, and that no distribution is installed over another."""
    spec = importlib.util.find_spec(PACKAGE)
    origins = [] if spec is None else list(spec.submodule_search_locations or ())
    if spec is not None and spec.origin is not None:
        origins = [str(Path(spec.origin).parent)]
    origin = Path(origins[0]).resolve() if origins else None
    if origin != ROOT / PACKAGE:
        remedy = "uninstall what brought it, unset PYTHONPATH, or leave the folder that holds it; then " + REINSTALL
        yield Check("package shadowing", f"another package comes first: {PACKAGE} from {origin}", Verdict.FAIL, remedy)
    else:
        yield Check("package shadowing", f"{PACKAGE} is imported from {origin}")
    owners = importlib.metadata.packages_distributions().get(PACKAGE, [])
    others = sorted({canonicalize_name(owner) for owner in owners} - {"marsyard"})
    if others:
        finding = f"{', '.join(others)} also installs a package named {PACKAGE}"
        yield Check("package names", finding, Verdict.WARN, f"pip uninstall {' '.join(others)}, then {REINSTALL}")
    for ours, rival in RIVALS:
        if _version(rival) is not None:
            finding = f"{rival} is installed over {ours}, into the same folder"
            yield Check("package names", finding, Verdict.FAIL, f"pip uninstall -y {rival} {ours}, then {REINSTALL}")


def check_dependencies(failures: Mapping[str, str]) -> Iterator[Check]:
    """Check the versions against pyproject.toml and constraints.txt; `failures` are those of `import_failures`."""
    pins = _pins()
    sound, unpinned = 0, []
    for requirement in _requirements():
        name = canonicalize_name(requirement.name)
        version = _version(name)
        if version is None:
            yield Check(name, "not installed", Verdict.FAIL, REINSTALL)
        elif not requirement.specifier.contains(version, prereleases=True):
            yield Check(name, f"{version}, but {requirement} is needed", Verdict.FAIL, REINSTALL)
        elif (fault := failures.get(_module(name))) is not None:
            yield Check(name, f"{version} cannot be imported: {fault}", Verdict.FAIL, REINSTALL)
        else:
            sound += 1
            if pins.get(name, version) != version:
                unpinned.append(f"{name} {version} (pinned {pins[name]})")
    yield Check("dependencies", f"{sound} import, in versions that Marsyard takes")
    if unpinned:
        yield Check("pinned versions", ", ".join(unpinned), Verdict.WARN, REINSTALL)


def import_failures(modules: Iterable[str]) -> dict[str, str]:
    """Import modules in a separate process; return the errors by module."""
    remaining = list(modules)
    failures: dict[str, str] = {}
    while remaining:
        ended = _run_python("-c", _IMPORT_ALL, *remaining)
        reached = [json.loads(line) for line in ended.stdout.splitlines()]
        failures |= {name: fault for name, fault in reached if fault}
        remaining = remaining[len(reached) :]
        if remaining:  # the first of these crashed the process
            failures[remaining.pop(0)] = _failure_reason(ended)
    return failures


_IMPORT_ALL = """
import importlib, json, sys
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
        fault = ""
    except Exception as error:
        fault = f"{type(error).__name__}: {error}"
    print(json.dumps([name, fault]), flush=True)
"""


def _requirements() -> list[Requirement]:
    requirements = [Requirement(text) for text in importlib.metadata.requires("marsyard") or []]
    return [r for r in requirements if r.marker is None or r.marker.evaluate({"extra": ""})]


def _pins() -> dict[str, str]:
    """Return the versions of constraints.txt by canonical name; empty without a checkout."""
    file = ROOT / "constraints.txt"
    lines = file.read_text().split() if file.is_file() else []
    return {canonicalize_name(name): version for name, _, version in (line.partition("==") for line in lines)}


def _module(distribution: str) -> str:
    return MODULES.get(distribution, distribution.replace("-", "_"))


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


@dataclass(frozen=True)
class Probe:
    """Measurements of a frame rendered with one backend, or the reason for the failure."""

    measured: Mapping[str, Any] | None
    fault: str = ""


def probe_backend(backend: str) -> Probe:
    """Render a frame with a backend in a separate process."""
    ended = _run_python("-P", str(Path(gl_probe.__file__)), backend)
    try:
        return Probe(json.loads(ended.stdout.splitlines()[-1]))
    except (IndexError, ValueError):
        return Probe(None, _failure_reason(ended))


def check_rendering(probes: Mapping[str, Probe]) -> Iterator[Check]:
    """Check each backend, and the one that a campaign would use."""
    checks = {backend: _check_backend(backend, probe) for backend, probe in probes.items()}
    yield from checks.values()
    sound = [backend for backend, check in checks.items() if check.verdict is Verdict.OK]
    wanted = os.environ.get("MARSYARD_GL", next(iter(BACKENDS))).lower()
    if wanted not in BACKENDS:
        fault = f"MARSYARD_GL is '{wanted}'; allowed: {', '.join(BACKENDS)}"
        yield Check("GL backend in use", fault, Verdict.FAIL, "unset MARSYARD_GL")
    elif wanted in sound:
        yield Check("GL backend in use", wanted)
    elif sound:
        remedy = f"export MARSYARD_GL={sound[0]}, or install {BACKENDS[wanted]}"
        yield Check("GL backend in use", f"{wanted}, which does not work; {sound[0]} does", Verdict.WARN, remedy)
    else:
        yield Check("GL backend in use", "none works", Verdict.FAIL, f"sudo apt-get install {BACKENDS[wanted]}")


def _check_backend(backend: str, probe: Probe) -> Check:
    name = f"GL: {backend}"
    remedy = f"sudo apt-get install {BACKENDS[backend]}"
    if probe.measured is None:
        return Check(name, probe.fault, Verdict.WARN, remedy)
    measured = probe.measured
    finding = f"{measured['renderer']}, {measured['version']}"
    error_m, offset = measured["depth_error_m"], measured["offset_px"]
    if not measured["lit"] or error_m > gl_probe.DEPTH_TOLERANCE_M:
        fault = f"; wrong picture: depth of a known plane off by {error_m:.3g} m"
        return Check(name, finding + fault, Verdict.WARN, "use the other backend, or another driver")
    finding += f"; depth right to {error_m * 1e3:.2g} mm at {gl_probe.DISTANCE_M:.0f} m"
    if max(map(abs, offset)) > gl_probe.OFFSET_TOLERANCE_PX:
        pixels = f"({offset[0]:+.3f}, {offset[1]:+.3f}) px"
        finding += f"; pyrender alone samples it {pixels} off-centre, Marsyard at the centre"
    return Check(name, finding)


def check_numba_cache() -> Check:
    """Check that compiled kernels can be cached; otherwise every process compiles them again."""
    with contextlib.suppress(ImportError):
        importlib.import_module("marsyard.sim")  # sets numba's folder, unless the user has
    folder = Path(os.environ.get("NUMBA_CACHE_DIR", Path.home() / ".cache" / "numba"))
    if _is_writable(folder):
        return Check("numba cache", f"{folder} is writable")
    remedy = "export NUMBA_CACHE_DIR=FOLDER, one you may write to"
    return Check("numba cache", f"cannot write to {folder}", Verdict.WARN, remedy)


def check_disk() -> Iterator[Check]:
    """Check the disk space for campaigns and for terrains."""
    yield _check_disk_space("disk, this folder", Path.cwd(), "free some, or run campaigns elsewhere with --out")
    remedy = "export MARSYARD_CACHE=FOLDER, one with room that you may write to"
    try:
        from marsyard.sim.cache import cache_directory

        cache = cache_directory("terrain")
    except (ImportError, OSError) as error:
        yield Check("disk, cache", str(error), Verdict.FAIL, remedy)
        return
    yield _check_disk_space("disk, cache", cache, remedy)


def _check_disk_space(name: str, folder: Path, remedy: str) -> Check:
    free = shutil.disk_usage(folder).free // MEBI
    if not _is_writable(folder):
        return Check(name, f"cannot write to {folder}", Verdict.FAIL, remedy)
    verdict = Verdict.OK if free >= 1024 else Verdict.FAIL if free < 100 else Verdict.WARN
    return Check(name, f"{free} MiB free in {folder}", verdict, "" if verdict is Verdict.OK else remedy)


def check_machine() -> Check:
    """Check cores and memory, of the machine or of a smaller control group; a worker needs about half a GiB."""
    cores, limits = _cores(), [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    group = Path("/sys/fs/cgroup/memory.max")
    if group.is_file() and (text := group.read_text().strip()).isdigit():
        limits.append(int(text))
    memory = min(limits) // MEBI
    finding = f"{cores} cores, {memory} MiB of memory"
    if memory < 512 * cores:
        return Check("cores and memory", finding, Verdict.WARN, f"run with --jobs {max(1, memory // 512)}")
    return Check("cores and memory", finding)


def check_threads(environment: Mapping[str, str], cores: int) -> Check:
    """Check the thread counts of the environment: more threads than cores slow the workers down."""
    counts = {name: environment[name] for name in THREAD_VARIABLES if environment.get(name)}
    finding = ", ".join(f"{name}={value}" for name, value in counts.items()) or "left to the libraries"
    if any(not value.isdigit() or int(value) > cores for value in counts.values()):
        return Check("threads", finding, Verdict.WARN, f"unset {' '.join(counts)}")
    return Check("threads", finding)


def check_systems() -> Iterator[Check]:
    """Check the systems under test of Marsyard and of other packages."""
    try:
        from marsyard.scenarios.systems import BUILT_IN, registry

        systems = registry()
    except ImportError as error:
        yield Check("systems", f"cannot be read: {error}", Verdict.FAIL, REINSTALL)
        return
    others = ", ".join(one.name for one in systems.systems[len(BUILT_IN) :])
    yield Check("systems", f"{len(BUILT_IN)} of Marsyard; of other packages: {others or 'none'}")
    for problem in systems.problems:
        yield Check("systems", problem, Verdict.WARN, "correct or uninstall the package that has the system")


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=PROBE_LIMIT_S, check=False)  # noqa: S603
    except subprocess.TimeoutExpired as expired:
        printed = expired.stdout.decode() if isinstance(expired.stdout, bytes) else ""
        return subprocess.CompletedProcess(command, -1, printed, f"no answer within {PROBE_LIMIT_S:.0f} s")


def _failure_reason(ended: subprocess.CompletedProcess[str]) -> str:
    lines = [line.strip() for line in ended.stderr.splitlines() if line.strip()]
    return lines[-1] if lines else f"the process ended with status {ended.returncode}"
