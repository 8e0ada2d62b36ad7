#!/usr/bin/env bash
# Runs the small rendered campaign and prints its verdict. Exit status 0 if no requirement failed: 48 cases with up to five
# failures decide an availability of 80 % at 90 % confidence, and are too few for 99 % (exit status 3 of the campaign).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
campaign=${CAMPAIGN:-dimes-smoke}
out=${OUT:-runs/$campaign-$(date -u +%Y%m%dT%H%M%SZ)}
backends=$(.venv/bin/python tools/gl_backends.py)
export MARSYARD_GL=${MARSYARD_GL:-${backends%% *}}

status=0
.venv/bin/marsyard run "$campaign" --out "$out" -n "${CASES:-48}" || status=$?
case $status in
    0 | 3) ;;
    *)
        echo "demo: the campaign failed with exit code $status (1: a requirement failed or a case crashed; 2: it could not run)" >&2
        exit "$status"
        ;;
esac
[ -f "$out/report.html" ] || { echo "demo: the campaign ran but wrote no $out/report.html" >&2; exit 1; }
verdict=$(.venv/bin/python -c 'import json, sys; print(json.load(open(sys.argv[1]))["verdict"])' "$out/report.json")
echo "demo: verdict $verdict, report $out/report.html"
