#!/usr/bin/env bash
# Runs the tests on all cores; words given are passed to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# the tests start hundreds of processes: without stored bytecode each one compiles all modules again
unset PYTHONDONTWRITEBYTECODE
# the tests of a file run in one process, so that their fixtures are created once
exec .venv/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder --durations=50 --durations-min=1 "$@"
