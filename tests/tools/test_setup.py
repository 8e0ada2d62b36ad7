"""Tests of the set-up script, the demo script and the constraints. The tests install no package."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from marsyard.campaigns.definition.loading import load_campaign
from marsyard.reports.statistics.proportions import minimum_sample_size

ROOT = Path(__file__).resolve().parents[2]
#: All shell scripts of the repository.
SCRIPTS = sorted([*(ROOT / "tools").glob("*.sh"), ROOT / ".ci" / "run"])


def write_executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Create a checkout with the scripts, a fake pip that installs nothing and a fake apt-get that fails."""
    root = tmp_path / "checkout"
    shutil.copytree(ROOT / "tools", root / "tools", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, root / name)
    write_executable(root / "tools" / "gl_backends.py", "print('egl')\n")
    write_executable(root / "marsyard" / "gl_probe.py", "print('{}')\n")
    write_executable(tmp_path / "bin" / "apt-get", "#!/bin/sh\necho apt-get $* >>$APT_LOG\nexit 100\n")
    write_executable(tmp_path / "bin" / "sudo", "#!/bin/sh\nexit 1\n")
    # This Python creates an environment without the module venv, which needs seconds.
    fake_python = f"""#!/bin/sh
case "$*" in
    "-m venv "*)
        mkdir -p .venv/bin
        cp "$0" .venv/bin/python
        printf '#!/bin/sh\\nexit 0\\n' >.venv/bin/pip
        chmod +x .venv/bin/pip ;;
    "-m pip "*) echo "pip $*" >>"$PIP_LOG"; exit "${{PIP_STATUS:-0}}" ;;
    *) exec {sys.executable} "$@" ;;
esac
"""
    write_executable(tmp_path / "bin" / "python3", fake_python)
    return root


def run_setup(checkout: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    home = checkout.parent
    variables = {
        "PATH": f"{home / 'bin'}:/usr/bin:/bin",
        "HOME": str(home),
        "PIP_LOG": str(home / "pip.log"),
        "APT_LOG": str(home / "apt.log"),
    }
    return subprocess.run(
        ["bash", str(checkout / "tools" / "setup.sh"), *arguments],
        env=variables | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def count_lines(file: Path) -> int:
    return len(file.read_text().splitlines()) if file.exists() else 0


def test_second_setup_changes_nothing(checkout: Path) -> None:
    assert run_setup(checkout).returncode == 0
    pip_calls = count_lines(checkout.parent / "pip.log")
    second = run_setup(checkout)
    assert (second.returncode, second.stdout, second.stderr) == (0, "", "")
    assert count_lines(checkout.parent / "pip.log") == pip_calls > 0


def test_setup_adds_the_tools_after_a_demo(checkout: Path) -> None:
    log = checkout.parent / "pip.log"
    run_setup(checkout, "--demo")
    assert ".[dask,geo,spice]" in log.read_text()
    calls = count_lines(log)
    run_setup(checkout, "--demo")
    assert count_lines(log) == calls
    assert run_setup(checkout).returncode == 0
    assert ".[dask,dev,docs,geo,spice]" in log.read_text()
    calls = count_lines(log)
    # the complete environment is also the demo's
    assert run_setup(checkout, "--demo").stdout == ""
    assert count_lines(log) == calls


@pytest.mark.parametrize("file_name", ["pyproject.toml", "constraints.txt", "tools/setup.sh"])
def test_changed_requirements_are_installed_again(checkout: Path, file_name: str) -> None:
    run_setup(checkout)
    pip_calls = count_lines(checkout.parent / "pip.log")
    with (checkout / file_name).open("a") as file:
        file.write("\n# changed\n")
    assert run_setup(checkout).returncode == 0
    assert count_lines(checkout.parent / "pip.log") == 2 * pip_calls


def test_interrupted_setup_starts_again(checkout: Path) -> None:
    assert run_setup(checkout, PIP_STATUS="1").returncode != 0
    old_file = checkout / ".venv" / "old_file"
    old_file.touch()
    assert run_setup(checkout).returncode == 0
    assert not old_file.exists()


def test_moved_checkout_is_set_up_again(checkout: Path) -> None:
    run_setup(checkout)
    (checkout / ".venv" / "old_file").touch()
    new_checkout = checkout.rename(checkout.with_name("moved"))
    assert run_setup(new_checkout).returncode == 0
    assert not (new_checkout / ".venv" / "old_file").exists()


def test_missing_backend_gives_one_line_and_status_0(checkout: Path) -> None:
    result = run_setup(checkout)
    assert result.returncode == 0
    assert result.stdout.count("sudo apt-get install libosmesa6 libgl1 libxrender1\n") == 1


def test_setup_fails_without_any_backend(checkout: Path) -> None:
    write_executable(checkout / "tools" / "gl_backends.py", "print('')\n")
    result = run_setup(checkout)
    assert result.returncode == 1
    assert "nothing to render with: install libosmesa6 libgl1 libxrender1, or else libegl1" in result.stderr
    assert count_lines(checkout.parent / "pip.log") == 0


def test_setup_fails_if_the_backend_does_not_render(checkout: Path) -> None:
    write_executable(checkout / "marsyard" / "gl_probe.py", "raise SystemExit(1)\n")
    assert "no GL backend renders" in run_setup(checkout).stderr


@pytest.mark.parametrize(
    # Exit codes of the campaign and of the demo, and the campaign's verdict.
    ("status", "expected", "verdict"),
    # The demo reads the verdict from the report, because several verdicts have exit code 3.
    [(0, 0, "PASS"), (3, 0, "INSUFFICIENT"), (3, 0, "MET BY RATE"), (1, 1, "FAIL"), (2, 2, "FAIL")],
)
def test_demo_succeeds_if_the_campaign_was_run(checkout: Path, status: int, expected: int, verdict: str) -> None:
    report = f'echo \'{{"verdict": "{verdict}"}}\' >"$4/report.json"'
    program = f'#!/bin/sh\nmkdir -p "$4" && echo page >"$4/report.html" && {report}\nexit {status}\n'
    write_executable(checkout / ".venv" / "bin" / "marsyard", program)
    write_executable(checkout / ".venv" / "bin" / "python", f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    result = subprocess.run(["bash", str(checkout / "tools" / "demo.sh")], capture_output=True, text=True, check=False)
    assert result.returncode == expected
    if expected == 0:
        last_line = result.stdout.splitlines()[-1]
        assert f"verdict {verdict}," in last_line
        assert (checkout / last_line.split()[-1]).is_file()
    else:
        assert f"exit code {status}" in result.stderr


def test_demo_has_enough_cases_to_decide_a_requirement() -> None:
    text = next(script for script in SCRIPTS if script.name == "demo.sh").read_text()
    (cases,) = map(int, re.findall(r'-n "\$\{CASES:-(\d+)\}"', text))
    requirements = {entry.id: entry for entry in load_campaign("dimes-smoke").definition.requirements}

    def count_needed(name: str, failures: int) -> int:
        return minimum_sample_size(requirements[name].probability, requirements[name].confidence, failures)

    assert cases < count_needed("DIMES-VEL", 0)
    # P(X <= 5) = 0.06, and P(X <= 6) = 0.13, for 48 cases that fail with the probability 0.2
    assert count_needed("DIMES-AVAIL", 5) <= cases < count_needed("DIMES-AVAIL", 6)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_scripts_parse_and_are_executable(script: Path) -> None:
    assert os.access(script, os.X_OK)
    subprocess.run(["bash", "-n", str(script)], check=True)


def test_constraints_pin_every_dependency() -> None:
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    assert [pin for pin in pins if not re.fullmatch(r"[a-z0-9-]+==[0-9][A-Za-z0-9.]*", pin)] == []
    assert pins == sorted(set(pins), key=lambda pin: pin.split("==")[0])
    project = (ROOT / "pyproject.toml").read_text()
    dependencies = set(re.findall(r'"([A-Za-z0-9-]+)>=[0-9.]+"', project))
    assert dependencies
    assert dependencies - {pin.split("==")[0] for pin in pins} == set()
