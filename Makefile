# Marsyard's tasks; `make` lists them. Each one first runs the set-up, which returns immediately if it is complete; that of
# the demo leaves out the tools for tests and documentation.

.DEFAULT_GOAL := help
.PHONY: help setup demo test lint format bench bench-check docs validate constraints clean distclean

BIN := .venv/bin
# Further arguments of pytest: make test PYTEST_ARGS="-k camera"
PYTEST_ARGS ?=

help: ## List the tasks
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-12s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## Install system libraries and the environment in .venv
	@tools/setup.sh

demo: ## Run a small rendered descent campaign and write its report
	@tools/setup.sh --demo
	@tools/demo.sh

test: setup ## Run all checks and tests
	@tools/compile_and_lint.sh
	@tools/test.sh $(PYTEST_ARGS)

lint: setup ## Run the static checks: ruff, mypy, import-linter, codespell, rejected words
	@tools/lint.sh

format: setup ## Format the sources, and correct what ruff can correct
	$(BIN)/ruff check --no-cache --fix-only .
	$(BIN)/ruff format .

bench: setup ## Measure speed and memory
	$(BIN)/marsyard compile
	$(BIN)/python -m benchmarks
	$(BIN)/python -m benchmarks.growth

validate: setup ## Run the slow tests, and compare with the papers' published results
	@tools/setup.sh --slow-tests
	@$(BIN)/python -m pip install -qq --no-input --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[network,notebook,view]'
	@tools/test.sh -m slow
	$(BIN)/python -m benchmarks.validation

bench-check: setup ## Compare the speed of hot paths with the stored ratios
	$(BIN)/python -m benchmarks.check

docs: setup ## Build the documentation site into build/docs
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/docs
	@echo "documentation: build/docs/index.html"

constraints: ## Renew the pinned versions in constraints.txt
	@tools/constraints.sh

clean: ## Remove runs, caches and build products; keep .venv
	rm -rf runs build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .coverage
	find . -name .venv -prune -o -name .git -prune -o -type d -name __pycache__ -exec rm -rf {} +

distclean: clean ## Remove all that is not source, .venv included
	rm -rf .venv *.egg-info
