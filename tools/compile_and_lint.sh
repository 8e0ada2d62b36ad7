#!/usr/bin/env bash
# Compiles the numeric kernels while the static checks run: both use one core most of the time.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset PYTHONDONTWRITEBYTECODE
.venv/bin/marsyard compile >/dev/null </dev/null & compilation=$!
tools/lint.sh
status=$?
# without compiled kernels the tests still pass, but are slower: each process compiles what it needs
wait "$compilation" || echo "kernels were not compiled: 'marsyard compile' shows the cause" >&2
exit "$status"
