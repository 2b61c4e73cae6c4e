# `make fly` and `make test` each work alone, in a fresh clone, with Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
# One stamp: the environment is made again only when what goes into it changes.
STAMP := $(VENV)/.installed

.PHONY: fly test docs clean

fly: $(STAMP)
	$(VENV)/bin/uavctl loopback --udp --config room

test: $(STAMP)
	$(VENV)/bin/python tools/check.py

docs: $(STAMP)
	$(VENV)/bin/python tools/check.py --write-docs

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt setuptools wheel
	$(VENV)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[dev]'
	touch $(STAMP)

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
