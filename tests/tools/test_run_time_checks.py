"""Tests that array shapes are checked at run time in the tests, except in modules of compiled kernels."""

import importlib
import sys
from pathlib import Path

import jaxtyping
import numpy as np
import pytest

from marsyard.sim.frames import direction, rigid


def test_wrong_shape_is_rejected() -> None:
    rotation = importlib.import_module("scipy.spatial.transform").Rotation.identity()
    with pytest.raises(jaxtyping.TypeCheckError):
        rigid(rotation, np.zeros(4))


def test_correct_shape_is_accepted() -> None:
    assert direction(0.0, 0.0).shape == (3,)


def test_kernel_modules_are_not_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Two temporary modules with the same function, imported as marsyard.algorithms.kernels and .functions.
    source = "def f(x: int) -> int:\n    return x\n"
    for package, module in (("marsyard.algorithms", "kernels"), ("marsyard.algorithms", "functions")):
        (tmp_path / f"{module}.py").write_text(source)
        monkeypatch.delitem(sys.modules, f"{package}.{module}", raising=False)
    monkeypatch.setattr(importlib.import_module("marsyard.algorithms"), "__path__", [str(tmp_path)])
    kernel = importlib.import_module("marsyard.algorithms.kernels").f
    function = importlib.import_module("marsyard.algorithms.functions").f
    monkeypatch.delitem(sys.modules, "marsyard.algorithms.kernels")
    monkeypatch.delitem(sys.modules, "marsyard.algorithms.functions")

    assert kernel("a text") == "a text"
    with pytest.raises(jaxtyping.TypeCheckError):
        function("a text")
