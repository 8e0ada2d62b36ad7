#!/usr/bin/env bash
# Runs the tests on all cores; words given are passed to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
exec .venv/bin/python -m pytest -n auto "$@"
