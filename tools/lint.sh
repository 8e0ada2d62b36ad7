#!/usr/bin/env bash
# The static checks: all of them, or those named (lint format types imports spelling words). pre-commit and `make lint`
# run the same.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bin=.venv/bin
[ -x "$bin/ruff" ] || { echo "lint: no environment: run 'make setup' first" >&2; exit 2; }

check() {
    case "$1" in
        # without its cache, which is outdated after a folder has moved
        lint) "$bin/ruff" check --no-cache . ;;
        format) "$bin/ruff" format --check . ;;
        types) "$bin/mypy" ;;
        imports) "$bin/lint-imports" --no-logo ;;
        spelling) "$bin/codespell" ;;
        # words that docs/glossary.md replaces; git grep succeeds if it finds one
        words)
            git grep --untracked -nPif tools/rejected_words.txt -- '*.py' 'docs/*.md' README.md
            [ $? -eq 1 ] || { echo "lint: replace these words (tools/rejected_words.txt)" >&2; return 1; } ;;
        *) echo "lint: no check named $1 (lint, format, types, imports, spelling, words)" >&2; return 2 ;;
    esac
}

failed=()
for name in "${@:-}"; do
    [ -n "$name" ] || continue
    check "$name" || failed+=("$name")
done
if [ $# -eq 0 ]; then
    for name in lint format types imports spelling words; do
        echo "== $name"
        check "$name" || failed+=("$name")
    done
fi
if [ ${#failed[@]} -gt 0 ]; then
    echo "lint: failed: ${failed[*]}" >&2
    exit 1
fi
