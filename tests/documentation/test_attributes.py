"""Tests that the documentation shows attributes separately if one description covers several names."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
#: Module with one description for three attributes, in two lines.
MODULE = '''
class Mean:
    """A mean.

    Attributes
    ----------
    mean, lower, upper
        Mean and its interval,
        both in metres.
    n
        Values.
    """
'''


@pytest.mark.slow
def test_attributes_in_one_line_are_rendered_separately(tmp_path: Path) -> None:
    source = tmp_path / "docs"
    source.mkdir()
    (tmp_path / "sample_module.py").write_text(MODULE)
    conf = (DOCS / "conf.py").read_text()
    # use the configuration of the site, but do not generate its pages and figures
    for call in ("    write_pages()\n", '    draw_figures(Path(__file__).parent / "generated")\n'):
        assert call in conf
        conf = conf.replace(call, "")
    (source / "conf.py").write_text(conf.replace("Path(__file__).parent))", f"Path({str(DOCS)!r})))"))
    (source / "index.md").write_text("# Index\n\n```{eval-rst}\n.. automodule:: sample_module\n```\n")
    # in a separate process, because pytest would turn the warnings of Sphinx into errors
    command = [sys.executable, "-m", "sphinx", "-q", "-b", "text", str(source), str(tmp_path / "out")]
    subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(tmp_path)}, timeout=120)
    text = (tmp_path / "out" / "index.txt").read_text()
    for name in ("mean", "lower", "upper"):
        assert f"* **{name}** -- Mean and its interval, both in metres." in " ".join(text.split())
    assert "* **n** -- Values." in text
