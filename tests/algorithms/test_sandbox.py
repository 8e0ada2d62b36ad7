"""The sandbox of untrusted algorithms: no files, processes, network or variables except their own."""

import os
import shutil
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError

from marsyard.algorithms.dimes import DimesOptions
from marsyard.algorithms.exchange import ExecutableLimits, limits, sandbox
from marsyard.algorithms.exchange.serving import end_idle_programs
from marsyard.scenarios.conformance import inputs
from marsyard.scenarios.velocity import VELOCITY

#: Searches for the file of its caller, its processes, the network, variables, and writes outside of its folder.
ATTEMPTS = """
    import json, os, socket, sys
    from pathlib import Path

    def attempts():
        found = []
        if Path(PRIVATE).exists(): found.append("private file")
        processes = [int(path.name) for path in Path("/proc").glob("[0-9]*")]
        if len(processes) > 5 or PARENT in processes: found.append("processes")
        try:
            socket.create_connection(("127.0.0.1", PORT), 1.0); found.append("network")
        except OSError: pass
        if "SECRET" in os.environ: found.append("variable")
        for folder in (Path(PRIVATE).parent, Path(__file__).parent):
            try:
                Path(folder, "written").write_text("1")  # in the sandbox only into its own memory
            except OSError: pass
        Path(os.environ["TMPDIR"], "own").write_text("1")
        return found
"""
PROGRAM = (
    ATTEMPTS
    + """
    assert json.loads(Path(sys.argv[-1], "case.json").read_text())["exchange"] == 3
    print(attempts() or json.dumps({"exchange": 3, "outcome": "NO_VALID_TRACK"}))
"""
)
MODULE = (
    ATTEMPTS
    + """
    from marsyard.algorithms.interface import VelocityEstimate, VelocityOutcome

    class Own:
        def estimate(self, measurements):
            if found := attempts(): raise RuntimeError(found)
            return VelocityEstimate(VelocityOutcome.NO_VALID_TRACK, None)
"""
)


@pytest.fixture(autouse=True)
def _end_programs() -> Iterator[None]:
    yield
    end_idle_programs()


@pytest.mark.slow  # needs bubblewrap
@pytest.mark.parametrize(("text", "prefix"), [(PROGRAM, f"exec:{sys.executable} "), (MODULE, "")])
@pytest.mark.parametrize("is_sandboxed", [True, False])
def test_untrusted_algorithm_reaches_only_its_inputs(
    text: str, prefix: str, is_sandboxed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the sandbox the same attempts succeed."""
    import socket

    private = tmp_path / "private" / "campaign.json"
    private.parent.mkdir()
    private.write_text("seed")
    folder = tmp_path / "code"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SECRET", "1")
    with socket.create_server(("127.0.0.1", 0)) as server:
        values = f"PRIVATE, PARENT, PORT = {str(private)!r}, {os.getpid()}, {server.getsockname()[1]}\n"
        name = f"own_code_{is_sandboxed}"
        (folder / f"{name}.py").write_text(values + textwrap.dedent(text))
        spec = f"{prefix}{name}.py" if prefix else f"{name}:Own"
        estimator = VELOCITY.make(spec, DimesOptions(), ExecutableLimits(sandbox=is_sandboxed))
        if is_sandboxed:
            assert estimator.estimate(inputs.descent()).outcome.name == "NO_VALID_TRACK"
        else:
            with pytest.raises(Exception, match=r"private file.*processes.*network.*variable"):
                estimator.estimate(inputs.descent())
    written = [path.parent.name for path in sorted(tmp_path.rglob("written"))]
    assert written == ([] if is_sandboxed else ["code", "private"])


def test_sandbox_without_bubblewrap_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    sandbox.find_problem.cache_clear()
    with pytest.raises(ValidationError, match="this machine has no sandbox: the program bwrap is not installed"):
        ExecutableLimits(sandbox=True)
    sandbox.find_problem.cache_clear()


@pytest.mark.parametrize(
    ("values", "message"),
    [({"devices": ["cuda:0"]}, "allowed in the sandbox: cpu"), ({"isolated": False}, "allowed in the sandbox: true")],
)
def test_settings_that_the_sandbox_cannot_enforce_are_refused(
    values: dict[str, object], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "find_problem", lambda: "")
    with pytest.raises(ValidationError, match=message):
        ExecutableLimits.model_validate({"sandbox": True, **values})


@pytest.mark.parametrize("word", ["", "x" * 300])
def test_words_that_name_no_file_make_nothing_visible(word: str, tmp_path: Path) -> None:
    """An empty word is not the working folder; a word can be longer than any name of a file."""
    folder = Path("/folder")
    words, without = (sandbox.sandbox_words(w, {}, folder, tmp_path, []) for w in (["true", word], ["true"]))
    assert words[:-1] == without
    assert words[-1] == word
