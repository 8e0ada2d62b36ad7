#!/usr/bin/env bash
# Runs the tests on all cores; words given are passed to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
# tests that share something costly stay in one process: `xdist_group`
exec .venv/bin/python -m pytest -n auto --dist loadgroup "$@"
