# `make fly` and `make test` each work alone, in a fresh clone, with Python >= 3.11 and make.
PYTHON ?= python3
VENV := .venv
# Not quiet: a download that takes a minute shows how far it is.
PIP := $(VENV)/bin/python -m pip install --disable-pip-version-check -c constraints.txt
# Stamps: the environment is made again only when what goes into it changes. To fly needs a fifth of what tests need.
FLIES := $(VENV)/.flies
STAMP := $(VENV)/.installed

# MAVSDK 3 and 4 have one name, so each client has an environment of its own.
CLIENTS := .venv-clients
ROS2 := .venv-ros2
LOWEST := .venv-lowest

.PHONY: fly test test-all test-long test-manual test-clients test-live test-ros2 test-lowest mutation docs site clean

fly: $(FLIES)
	$(VENV)/bin/uavctl loopback --udp --config room

# A person's loop, before each commit; test-all adds slow tests and the built wheel.
test: $(STAMP)
	$(VENV)/bin/python tools/check.py

test-all: $(STAMP)
	$(VENV)/bin/python tools/check.py --all

# Many whole flights and statistics of thousands of runs: evidence that continuous integration makes anew.
test-long: $(STAMP)
	$(VENV)/bin/python tools/check.py --long

# Types the commands of the manual's pages as a reader would, in real time, against simulated vehicles.
test-manual: $(STAMP)
	$(VENV)/bin/python -m pytest -n 2 -m manual tests/e2e/test_manual.py

# The core, configurations, recordings and the Python API with the lowest versions that pyproject.toml permits.
test-lowest: $(LOWEST)/.installed
	$(LOWEST)/bin/python -m pytest -n 0 -m "not slow and not long" tests/smpc tests/flight tests/config tests/logs/recording \
		tests/api/test_python_api.py

test-clients: $(STAMP) $(CLIENTS)/.installed
	UAVCTL_MAVSDK_PYTHON=$(CURDIR)/$(CLIENTS)/mavsdk/bin/python \
	UAVCTL_MAVSDK3_PYTHON=$(CURDIR)/$(CLIENTS)/mavsdk3/bin/python \
	UAVCTL_MAVPROXY_PYTHON=$(CURDIR)/$(CLIENTS)/mavproxy/bin/python \
	$(VENV)/bin/python -m pytest -n 0 tests/clients --ignore=tests/clients/test_live_browser.py

# Buttons of the live page in a real browser, with a vehicle in real time: alone, as it needs the processor.
test-live: $(STAMP)
	$(VENV)/bin/python -m pytest -n 0 tests/clients/test_live_browser.py

# Real nodes of ROS 2 over localhost, in an environment that has the extra: no other test needs it.
test-ros2: $(ROS2)/.installed
	$(ROS2)/bin/python -m pytest -n 0 tests/ros2

# The safety core: every small change of it fails one of its own tests (docs/safety-core.md). About 20 minutes.
mutation: $(STAMP)
	$(VENV)/bin/python tools/mutation.py

docs: $(STAMP)
	$(VENV)/bin/python tools/check.py --write-docs
	$(VENV)/bin/python tools/pictures.py

# The manual as a site, in site/: open site/index.html. A page, link or heading that is missing fails the build.
site: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict --clean --config-file tools/mkdocs.yml

$(FLIES): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	@echo "setting up $(VENV), once"
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(PIP) setuptools wheel
	$(PIP) --no-build-isolation -e .
	touch $@

$(STAMP): $(FLIES)
	@echo "adding to $(VENV) what tests need, once: a minute or two with the downloads"
	$(PIP) --no-build-isolation -e '.[dev]'
	touch $@

$(CLIENTS)/.installed: constraints-clients.txt
	for client in mavsdk mavsdk3 mavproxy; do $(PYTHON) -m venv $(CLIENTS)/$$client; done
	$(CLIENTS)/mavsdk/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-clients.txt mavsdk==4.1.0
	$(CLIENTS)/mavsdk3/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-clients.txt mavsdk==3.17.4
	$(CLIENTS)/mavproxy/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-clients.txt --no-deps MAVProxy
	$(CLIENTS)/mavproxy/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-clients.txt pyserial pymavlink
	touch $@

$(LOWEST)/.installed: pyproject.toml constraints-lowest.txt
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check 'setuptools>=77' wheel
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints-lowest.txt --no-build-isolation \
		-e '.[campaign,pandas,polars,ulog]' hypothesis mcap-ros1-support mcap-ros2-support pytest pytest-xdist
	touch $@

$(ROS2)/.installed: pyproject.toml constraints.txt constraints-ros2.txt
	$(PYTHON) -m venv $(ROS2)
	$(ROS2)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt setuptools wheel
	$(ROS2)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -c constraints-ros2.txt \
		--no-build-isolation -e '.[ros2]' hypothesis pytest pytest-xdist
	touch $@

clean:
	rm -rf $(VENV) $(CLIENTS) $(ROS2) $(LOWEST) build dist site *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
