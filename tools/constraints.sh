#!/usr/bin/env bash
# Renews constraints.txt: installs the newest versions that pyproject.toml allows into a fresh environment and writes
# down what came, as plain name==version lines. Review the difference and run `make test` before you commit it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=${PYTHON:-python3}
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

"$python" -m venv "$scratch/venv"
"$scratch/venv/bin/python" -m pip install -qq --upgrade pip setuptools
"$scratch/venv/bin/python" -m pip install -qq --no-build-isolation -e '.[bench,dask,dev,docs,geo,network,notebook,spice,validate,view]'
"$scratch/venv/bin/python" - >"$scratch/constraints.txt" <<'PYTHON'
import re
from importlib.metadata import distributions

pins = {re.sub("[-_.]+", "-", d.name.lower()): d.version for d in distributions() if d.name != "marsyard"}
for name, version in sorted(pins.items()):
    print(f"{name}=={version}")
PYTHON
cp "$scratch/constraints.txt" constraints.txt
wc -l constraints.txt
