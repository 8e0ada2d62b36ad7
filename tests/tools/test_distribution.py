"""Tests of the files that distribute Marsyard: container file, conda recipe, GitHub workflow and release notes."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
CONTAINER_FILE = ROOT / "packaging" / "Containerfile"
#: Names of packages that differ between PyPI and conda-forge; None for a package without a conda package.
CONDA_NAMES = {"opencv-python-headless": "py-opencv", "matplotlib": "matplotlib-base", "pyrender2": None}


def read_project() -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return project


def test_container_file_has_no_findings() -> None:
    hadolint = Path(sys.executable).with_name("hadolint")
    result = subprocess.run([hadolint, str(CONTAINER_FILE)], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_container_has_all_sources_and_libraries() -> None:
    text = CONTAINER_FILE.read_text()
    copied = set(re.findall(r"^COPY (\w+) /source/\w+$", text, re.MULTILINE))
    packages = {path.resolve().name for path in (ROOT / "marsyard").iterdir() if path.is_symlink()}
    assert packages
    assert copied == {"marsyard", *packages}
    for path in re.findall(r"^COPY (.+) /source/$", text, re.MULTILINE)[0].split():
        assert (ROOT / path).is_file(), path
    # the page on clusters uses Dask, and campaigns may have terrain files
    assert re.search(r"pip install .* '\.\[dask,geo\]' ", text)
    # the libraries are those of the set-up
    match = re.search(r"^osmesa=\((.*)\)$", (ROOT / "tools" / "setup.sh").read_text(), re.MULTILINE)
    assert match is not None
    assert set(match[1].split()) <= set(text.split())


def test_conda_recipe_has_the_dependencies_of_the_package() -> None:
    recipe = yaml.safe_load((ROOT / "packaging" / "conda" / "recipe.yaml").read_text())
    project = read_project()
    assert recipe["context"]["version"] == project["version"]
    requirements = dict(entry.partition(" ")[::2] for entry in recipe["requirements"]["run"])
    assert requirements["python"] == project["requires-python"]
    for dependency in project["dependencies"]:
        match = re.fullmatch(r"([\w-]+)(.*)", dependency)
        assert match is not None
        name = CONDA_NAMES.get(match[1], match[1])
        assert name is None or requirements[name] == match[2]
    pins = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().split())
    assert recipe["context"]["pyrender_version"] == pins["pyrender2"]


def test_workflow_runs_the_command_of_the_checks() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text())
    commands = [step["run"] for step in workflow["jobs"]["test"]["steps"] if "run" in step]
    assert commands == ["make test"]
    assert "make test" in (ROOT / ".ci" / "run").read_text()
    assert workflow["jobs"]["release"]["needs"] == "test"


def test_release_notes_are_a_section_of_the_changelog() -> None:
    script = ROOT / "tools" / "release_notes.sh"
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    result = subprocess.run([script, version], capture_output=True, text=True, check=True)
    assert "### Added" in result.stdout
    assert "## [" not in result.stdout
    unknown = subprocess.run([script, "0.0.0"], capture_output=True, text=True, check=False)
    assert (unknown.returncode, unknown.stderr) == (2, "release_notes: CHANGELOG.md has no section [0.0.0]\n")
