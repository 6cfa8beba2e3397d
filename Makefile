# Two commands on a bare machine that has Python 3.11 or newer (with venv) and make:
#   make quickstart    set up, train a small controller on synthetic gaits (about five minutes), evaluate it, let the
#                      pretrained student run the agility course, report both
#   make test          set up, lint, type check, test
# pip is configured as usual, by its own settings (for example PIP_INDEX_URL, or a pip.conf).

VENV := .venv
PYTHON := $(VENV)/bin/python
READY := $(VENV)/.agility_rl-is-set-up
NAME := quickstart-$(shell date +%Y%m%d-%H%M%S)
PYTEST_ARGS ?=

.PHONY: setup quickstart test lint format

setup: $(READY)

# Runs again only when what is to be installed has changed. The package itself is installed in place.
$(READY): pyproject.toml constraints.txt
	@for candidate in $(SYSTEM_PYTHON) python3 python3.13 python3.12 python3.11; do \
		if $$candidate -c 'import sys, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then found=$$candidate; break; fi; \
	done; \
	if [ -z "$$found" ]; then echo "expected Python 3.11 or newer on the PATH, found none; install one, or name it: make SYSTEM_PYTHON=/where/it/is"; exit 1; fi; \
	if [ ! -x $(PYTHON) ]; then echo "setup: new virtual environment $(VENV), made by $$found"; $$found -m venv $(VENV); fi
	$(PYTHON) -m pip install --disable-pip-version-check --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

quickstart: setup
	$(PYTHON) recipes/bbc_pretrain.py quickstart --name $(NAME)
	$(PYTHON) recipes/evaluate.py runs/$(NAME)
	$(PYTHON) recipes/evaluate_course.py pretrained/student_leaping --course full each --episodes 20 --episode-length 30 --output runs/$(NAME)/course
	$(PYTHON) recipes/report.py runs/$(NAME)
	@echo "report: $(CURDIR)/runs/$(NAME)/report.html"

lint: setup
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

format: setup
	$(PYTHON) -m ruff check --fix .
	$(PYTHON) -m ruff format .

test: lint
	@mkdir -p build
	$(PYTHON) -m pytest -n 2 --dist worksteal --junitxml=build/tests.xml $(PYTEST_ARGS)
