"""Tests of the wheel: it installs one package, `marsyard`, which works next to modules named `sim` or `reports`."""

import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[2]
#: Folders and files from which a wheel is built.
FOLDERS = ("sim", "algorithms", "scenarios", "campaigns", "reports")
SOURCES = ("marsyard", *FOLDERS, "pyproject.toml", "README.md", "LICENSE")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a wheel from a copy of the repository; symbolic links are copied as links."""
    tree, output_folder = tmp_path_factory.mktemp("tree"), tmp_path_factory.mktemp("wheel")
    for name in SOURCES:
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, tree / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / name, tree / name)
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index"]
    result = subprocess.run(
        [*command, "--disable-pip-version-check", "-w", str(output_folder), str(tree)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    (path,) = output_folder.glob("*.whl")
    return path


@pytest.mark.slow
def test_wheel_contains_one_package(wheel: Path) -> None:
    with ZipFile(wheel) as archive:
        names = archive.namelist()
    top_level_names = {name.partition("/")[0] for name in names}
    assert {name for name in top_level_names if not name.endswith(".dist-info")} == {"marsyard"}
    for name in (
        "sim/render/renderer.py", "scenarios/descent/requirements.toml", "reports/templates/report.css",
        "reports/validation.json", "reports/fitted.toml", "reports/credibility.toml",
    ):  # fmt: skip
        assert f"marsyard/{name}" in names
    sources = {
        path.relative_to(ROOT).as_posix()
        for folder in FOLDERS
        for pattern in ("*.py", "shaders/*")
        for path in (ROOT / folder).rglob(pattern)
    }
    assert "sim/render/shaders/segmentation.vert" in sources
    assert {f"marsyard/{source}" for source in sources} <= set(names)


def test_wheel_works_next_to_modules_of_the_same_names(wheel: Path, tmp_path: Path) -> None:
    install_folder, working_folder = tmp_path / "installed", tmp_path / "here"
    with ZipFile(wheel) as archive:
        archive.extractall(install_folder)
    for name in ("sim.py", "reports/__init__.py", "campaigns/__init__.py", "scenarios.py", "algorithms.py"):
        (working_folder / name).parent.mkdir(parents=True, exist_ok=True)
        (working_folder / name).write_text("raise ImportError('the wrong module')\n")
    script = (
        f"import sys; sys.path.insert(1, {str(install_folder)!r})\n"
        "import marsyard, marsyard.sim.camera, marsyard.reports.campaign_report\n"
        f"assert marsyard.__file__.startswith({str(install_folder)!r}), marsyard.__file__\n"
        "from marsyard.cli.app import main\nsys.argv = ['marsyard', 'show', 'dimes-smoke']\nmain()\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script], cwd=working_folder, capture_output=True, text=True, timeout=120, check=False
    )
    assert result.returncode == 0, result.stderr
    assert "DIMES-VEL" in result.stdout
