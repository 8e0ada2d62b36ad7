"""The set-up script and the tasks around it, without installing anything."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPTS = sorted([*(ROOT / "tools").glob("*.sh"), ROOT / ".ci" / "run"])


def executable(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)
    return path


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout as the scripts see it, whose pip installs nothing and whose packages cannot be had."""
    root = tmp_path / "checkout"
    shutil.copytree(ROOT / "tools", root / "tools", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, root / name)
    executable(root / "tools" / "gl_backends.py", "print('egl')\n")
    executable(root / "marsyard" / "gl_probe.py", "print('{}')\n")
    executable(tmp_path / "bin" / "apt-get", "#!/bin/sh\necho apt-get $* >>$APT_LOG\nexit 100\n")
    executable(tmp_path / "bin" / "sudo", "#!/bin/sh\nexit 1\n")
    # an interpreter that makes environments without pip: the venv module's work takes seconds
    fake = f"""#!/bin/sh
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
    executable(tmp_path / "bin" / "python3", fake)
    return root


def setup(checkout: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    home = checkout.parent
    variables = {
        "PATH": f"{home / 'bin'}:/usr/bin:/bin",
        "HOME": str(home),
        "PIP_LOG": str(home / "pip.log"),
        "APT_LOG": str(home / "apt.log"),
    }
    return subprocess.run(
        ["bash", str(checkout / "tools" / "setup.sh")],
        env=variables | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def lines(file: Path) -> int:
    return len(file.read_text().splitlines()) if file.exists() else 0


def test_a_second_set_up_does_nothing(checkout: Path) -> None:
    assert setup(checkout).returncode == 0
    installed = lines(checkout.parent / "pip.log")
    again = setup(checkout)
    assert (again.returncode, again.stdout, again.stderr) == (0, "", "")
    assert lines(checkout.parent / "pip.log") == installed > 0


@pytest.mark.parametrize("changed", ["pyproject.toml", "constraints.txt", "tools/setup.sh"])
def test_a_change_of_what_it_is_made_from_installs_again(checkout: Path, changed: str) -> None:
    setup(checkout)
    installed = lines(checkout.parent / "pip.log")
    with (checkout / changed).open("a") as file:
        file.write("\n# changed\n")
    assert setup(checkout).returncode == 0
    assert lines(checkout.parent / "pip.log") == 2 * installed


def test_what_was_interrupted_is_built_again(checkout: Path) -> None:
    assert setup(checkout, PIP_STATUS="1").returncode != 0
    leftover = checkout / ".venv" / "leftover"
    leftover.touch()
    assert setup(checkout).returncode == 0
    assert not leftover.exists()


def test_a_moved_checkout_is_set_up_again(checkout: Path) -> None:
    setup(checkout)
    (checkout / ".venv" / "leftover").touch()
    moved = checkout.rename(checkout.with_name("moved"))
    assert setup(moved).returncode == 0
    assert not (moved / ".venv" / "leftover").exists()


def test_a_missing_backend_is_named_in_one_line_and_not_fatal(checkout: Path) -> None:
    done = setup(checkout)
    assert done.returncode == 0
    assert done.stdout.count("sudo apt-get install libosmesa6 libgl1 libxrender1\n") == 1


def test_no_backend_at_all_is_fatal(checkout: Path) -> None:
    executable(checkout / "tools" / "gl_backends.py", "print('')\n")
    done = setup(checkout)
    assert done.returncode == 1
    assert "nothing to render with: install libosmesa6 libgl1 libxrender1, or else libegl1" in done.stderr
    assert lines(checkout.parent / "pip.log") == 0


def test_a_backend_that_does_not_render_is_fatal(checkout: Path) -> None:
    executable(checkout / "marsyard" / "gl_probe.py", "raise SystemExit(1)\n")
    assert "no GL backend renders" in setup(checkout).stderr


@pytest.mark.parametrize(
    ("status", "expected", "verdict"),
    # the word is the report's: exit code 3 goes with several
    [(0, 0, "PASS"), (3, 0, "INSUFFICIENT"), (3, 0, "MET BY RATE"), (1, 1, "FAIL"), (2, 2, "FAIL")],
)
def test_the_demo_succeeds_when_the_campaign_ran(checkout: Path, status: int, expected: int, verdict: str) -> None:
    report = f'echo \'{{"verdict": "{verdict}"}}\' >"$4/report.json"'
    run = f'#!/bin/sh\nmkdir -p "$4" && echo page >"$4/report.html" && {report}\nexit {status}\n'
    executable(checkout / ".venv" / "bin" / "marsyard", run)
    executable(checkout / ".venv" / "bin" / "python", f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    done = subprocess.run(["bash", str(checkout / "tools" / "demo.sh")], capture_output=True, text=True, check=False)
    assert done.returncode == expected
    if expected == 0:
        last = done.stdout.splitlines()[-1]
        assert f"verdict {verdict}," in last
        assert (checkout / last.split()[-1]).is_file()
    else:
        assert f"exit code {status}" in done.stderr


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_scripts_parse_and_are_executable(script: Path) -> None:
    assert os.access(script, os.X_OK)
    subprocess.run(["bash", "-n", str(script)], check=True)


def test_constraints_are_plain_pins_of_every_dependency() -> None:
    pins = (ROOT / "constraints.txt").read_text().splitlines()
    assert [pin for pin in pins if not re.fullmatch(r"[a-z0-9-]+==[0-9][A-Za-z0-9.]*", pin)] == []
    assert pins == sorted(set(pins), key=lambda pin: pin.split("==")[0])
    project = (ROOT / "pyproject.toml").read_text()
    needed = set(re.findall(r'"([A-Za-z0-9-]+)>=[0-9.]+"', project))
    assert needed
    assert needed - {pin.split("==")[0] for pin in pins} == set()
