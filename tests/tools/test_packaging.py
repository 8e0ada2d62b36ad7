"""What is installed is one package, `marsyard`, with any other modules on the path."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: What a distribution is built from.
FOLDERS = ("sim", "algorithms", "scenarios", "campaigns", "reports")
SOURCES = ("marsyard", *FOLDERS, "pyproject.toml", "README.md", "LICENSE")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of the tree, links kept as links."""
    tree, out = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, tree / name)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    done = subprocess.run(
        [*command, "--disable-pip-version-check", "-w", str(out), str(tree)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (built,) = out.glob("*.whl")
    return built


def test_a_wheel_holds_one_package(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        names = archive.namelist()
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"marsyard"}
    for name in ("sim/render/renderer.py", "scenarios/requirements.toml", "reports/templates/report.css"):
        assert f"marsyard/{name}" in names
    sources = {path.relative_to(ROOT).as_posix() for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    assert {f"marsyard/{source}" for source in sources} <= set(names)


def test_a_wheel_works_where_other_packages_have_these_names(wheel: Path, tmp_path: Path) -> None:
    installed, here = tmp_path / "installed", tmp_path / "here"
    with ZipFile(wheel) as archive:
        archive.extractall(installed)
    for name in ("sim.py", "reports/__init__.py", "campaigns/__init__.py", "scenarios.py", "algorithms.py"):
        (here / name).parent.mkdir(parents=True, exist_ok=True)
        (here / name).write_text("raise ImportError('the wrong module')\n")
    script = (
        f"import sys; sys.path.insert(1, {str(installed)!r})\n"
        "import marsyard, marsyard.sim.camera, marsyard.reports.campaign\n"
        f"assert marsyard.__file__.startswith({str(installed)!r}), marsyard.__file__\n"
        "from marsyard.cli.app import main\nsys.argv = ['marsyard', 'show', 'dimes-smoke']\nmain()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=here, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "DIMES-VEL" in done.stdout
