#!/usr/bin/env bash
# Prints the section of CHANGELOG.md for a version (or "Unreleased"), as the notes of its release.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
[ $# -eq 1 ] || { echo "usage: tools/release_notes.sh VERSION" >&2; exit 2; }
notes=$(awk -v heading="## [$1]" 'index($0, heading) == 1 { found = 1; next } /^## \[/ { found = 0 } found' CHANGELOG.md)
[ -n "${notes//[[:space:]]/}" ] || { echo "release_notes: CHANGELOG.md has no section [$1]" >&2; exit 2; }
printf '%s\n' "$notes"
