"""Runs every benchmark: ``python -m benchmarks``."""

from benchmarks import descent

descent.main()
