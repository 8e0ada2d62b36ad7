"""Test of the names of classes: each name has one meaning in all algorithms."""

import ast
from collections import Counter
from pathlib import Path

ALGORITHMS = Path(__file__).parents[2] / "algorithms"


def test_class_names_are_unique() -> None:
    trees = [ast.parse(path.read_bytes()) for path in ALGORITHMS.rglob("*.py")]
    names = Counter(node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    assert names["ImageStream"] == 1  # the folder contains the sources
    assert [name for name, count in names.items() if count > 1] == []
