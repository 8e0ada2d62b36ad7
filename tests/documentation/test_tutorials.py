"""Tests of the pages to try out: the commands of each tutorial succeed in an empty folder, and notebooks run."""

import ast
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
from typer.testing import CliRunner

from marsyard.cli.app import app

DOCS = Path(__file__).resolve().parents[2] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
CODE_BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: End of the text before a code block that is saved to a file.
FILE_NAME = re.compile(r"Save\s+it\s+as\s+`([\w./-]+)`:\s*\Z")
#: Link to an example file, which the reader copies to the same path in the folder of the tutorial.
EXAMPLE_LINK = re.compile(r"\]\(\.\./examples/([\w./-]+)\)")
#: Lines of an example file, shown in the text with an indentation of four columns.
EXCERPT = re.compile(r"(?:^ {4}.*\n(?:\n(?= {4}))?)+", re.MULTILINE)
#: Tutorials that need the packages of an extra, which `make validate` installs.
OPTIONAL_PACKAGES = {"neural-network": ("onnx", "onnxruntime")}
#: Files that exist after the tutorial.
EXPECTED_FILES = {
    "first-campaign": (
        *(f"first/{name}" for name in ("report.html", "cases.parquet", "cases.sqlite", "campaign.json")),
        "first/cases/3/dimes.png",
        "draws.svg",
    ),
    "custom-lander": ("mylander/report.html",),
    "measured-data": ("checked/report.html",),
    "custom-dynamics": ("powered/report.html",),
    "custom-instrument": ("lidar/report.html",),
    "custom-score": ("airbags/report.html",),
    "failure-analysis": (
        *(f"{name}/report.html" for name in ("counted", "again", "budget", "rare")),
        "searched/failures/nightly.toml",
    ),
    "neural-network": (
        *("online/report.html", "offline/report.html", "answers.csv", "velocity_network/network.onnx"),
        "smoke/cases/000023/image_3.png",
    ),
    "custom-system": ("fallen/report.html", "fallen/cases/2/altitude.png"),
}
#: Folder of the packages that a tutorial installs.
INSTALL_FOLDER = "installed"
#: Comment after a command that states its exit status, if it is not 0.
EXIT_CODES = re.compile(r"# exits with (\d)(?: or (\d))?")


@pytest.mark.slow
@pytest.mark.parametrize("tutorial", TUTORIALS, ids=[path.stem for path in TUTORIALS])
def test_tutorial_commands_succeed(tutorial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in OPTIONAL_PACKAGES.get(tutorial.stem, ()):
        pytest.importorskip(package)
    text = tutorial.read_text(encoding="utf-8")
    for name in EXAMPLE_LINK.findall(text):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(DOCS / "examples" / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    has_installation = "$ pip install" in text
    n_commands = 0
    for block in CODE_BLOCK.finditer(text):
        language, body = block.groups()
        match = FILE_NAME.search(text, 0, block.start())
        if match is not None:
            (tmp_path / match[1]).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / match[1]).write_text(body, encoding="utf-8")
            continue
        assert language != "toml", "the campaign is not saved to a file"
        if language == "python":
            _run_in_subprocess([sys.executable, "-c", body], {0})
        elif language == "console":
            for line in body.splitlines():
                assert line.startswith("$ "), line
                n_commands += 1
                allowed_codes = {int(code) for codes in EXIT_CODES.findall(line) for code in codes if code} or {0}
                arguments = shlex.split(line.removeprefix("$ ").split("#")[0])
                if arguments[:2] == ["pip", "install"]:
                    arguments[2:2] = ["--no-deps", "--no-build-isolation", "--target", INSTALL_FOLDER]
                run_command = (
                    _invoke_in_process if arguments[0] == "marsyard" and not has_installation else _run_in_subprocess
                )
                run_command(arguments, allowed_codes)
    assert n_commands >= 3
    for name in EXPECTED_FILES.get(tutorial.stem, ()):
        assert (tmp_path / name).stat().st_size > 0


def test_excerpts_are_parts_of_the_example_files() -> None:
    n_excerpts = 0
    for tutorial in TUTORIALS:
        text = tutorial.read_text(encoding="utf-8")
        sources = [(DOCS / "examples" / name).read_text(encoding="utf-8") for name in EXAMPLE_LINK.findall(text)]
        for excerpt in EXCERPT.findall(CODE_BLOCK.sub("", text)) if sources else ():
            n_excerpts += 1
            code = textwrap.dedent(excerpt).strip()
            assert any(code in textwrap.dedent(source) or excerpt.rstrip() in source for source in sources), code
    assert n_excerpts >= 2


def _invoke_in_process(arguments: list[str], allowed_codes: set[int]) -> None:
    result = CliRunner().invoke(app, arguments[1:])
    assert result.exit_code in allowed_codes, f"{arguments}: {result.exit_code}\n{result.output}\n{result.exception!r}"


def _run_in_subprocess(arguments: list[str], allowed_codes: set[int]) -> None:
    # packages of a tutorial are not installed into the environment of the tests
    search_path = os.pathsep.join((str(Path(__file__).parents[2]), str(Path(INSTALL_FOLDER).resolve())))
    environment = {**os.environ, "PYTHONPATH": search_path}
    command = [str(Path(sys.executable).parent / arguments[0]), *arguments[1:]]
    result = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert result.returncode in allowed_codes, f"{arguments}: {result.returncode}\n{result.stdout}\n{result.stderr}"
    assert "Traceback" not in result.stderr


NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))
names = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


@names
def test_notebook_is_stored_without_output(path: Path) -> None:
    notebook = json.loads(path.read_text())
    assert path.stat().st_size < 10_000
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None
            ast.parse("".join(cell["source"]))


@pytest.mark.slow
@names
def test_notebook_runs(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    monkeypatch.setenv("PYTHONPATH", str(DOCS.parent))
    notebook = nbformat.read(path, as_version=4)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=300, kernel_name="python3", resources=resources).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("text/html" in output.get("data", {}) for output in outputs)
