#!/usr/bin/env bash
# Make docs/examples/assurance.zip again: a small run of each system with the present program, in one assurance package.
# Arguments are passed to `marsyard run`, such as `--jobs 1`.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
python=$PWD/.venv/bin/python
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
for run in "dimes-smoke 12" "hda-hazardous 8" "loc-smoke 4" "vtt-montecarlo 3"; do
    read -r campaign cases <<< "$run"
    status=0
    "$python" -m marsyard run "$campaign" -n "$cases" --set retain.products=none --out "$folder/runs/$campaign" "$@" ||
        status=$?
    # 1, 3 and 4 are verdicts
    [[ $status =~ ^[0134]$ ]] || exit "$status"
done
rm -rf "$folder"/runs/*/cases  # the images of the reports are most of the package
"$python" -m marsyard assure "$folder"/runs/* --out "$folder/package"
(cd "$folder" && "$python" -m zipfile -c assurance.zip package)
mv "$folder/assurance.zip" docs/examples/assurance.zip
