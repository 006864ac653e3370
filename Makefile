# The one task runner; CI calls it too.
#   make setup       the environment: apt packages where they are missing, .venv with everything, kernels compiled
#   make demo        a simulated flight into the real daemon, processed to a cloud with pictures
#   make test        all tests but the long ones
#   make static      format, lint, types, import contracts
#   make check       those, then the tests
#   make soak        the long tests: hour-long logs, many seeds
#   make bench-NAME  one benchmark of benchmarks/; its last line is one JSON object
#   make bench       all of them, into docs/benchmarks.md, but the longest: `benchmarks/all.py --only kit study windows`
#   make docs        the pages as a site, site/index.html; warnings are errors
#   make deb         dist/swathd_VERSION_{amd64,arm64}.deb, for the payload computer
#   make release     dist/VERSION/: wheel, sdist, the packages, notes, SBOM and checksums; publishes nothing
#   make clean       everything made, the environment included

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:

VENV := .venv
BIN := $(VENV)/bin
PYTEST := $(BIN)/pytest
# A file of tests stays on one worker, so that what its fixtures made is made once; tests/conftest.py has the longest begin.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder

.PHONY: setup demo static test check soak bench docs deb release clean

setup: $(VENV)/.warm $(VENV)/.mavproxy

$(VENV)/.apt: apt-packages.txt
	@mkdir -p $(VENV)
	@missing=(); for package in $$(cat $<); do \
	  dpkg-query -W -f '$${Status}' "$$package" 2>/dev/null | grep -q 'ok installed' || missing+=("$$package"); \
	done; \
	if [ $${#missing[@]} -gt 0 ]; then \
	  echo "installing apt packages: $${missing[*]}"; \
	  if [ "$$(id -u)" = 0 ]; then sudo=(); else sudo=(sudo); fi; \
	  "$${sudo[@]}" apt-get update -q; \
	  "$${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -q -y --no-install-recommends "$${missing[@]}"; \
	  if [[ " $${missing[*]} " == *" openssh-server "* ]] && [ -d /run/systemd/system ]; then \
	    echo "openssh-server is here for the tests only: its service is switched off"; \
	    "$${sudo[@]}" systemctl disable --now ssh.service ssh.socket 2>/dev/null || true; \
	  fi; \
	fi
	@touch $@

# Debian's own Python 3.11 where there is one, else the newest that will do.
$(VENV)/.python: $(VENV)/.apt
	@for python in /usr/bin/python3.11 python3.14 python3.13 python3.12 python3.11 python3; do \
	  if "$$python" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	    [ -x $(BIN)/python ] || "$$python" -m venv $(VENV); \
	    touch $@; exit 0; \
	  fi; \
	done; echo "no Python of 3.11 or newer with venv was found" >&2; exit 1

$(VENV)/.installed: $(VENV)/.python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

# A test lets MAVProxy show our messages; what it would bring along (vtk, opencv) is not needed for that. It has to be built, and
# so comes beside the kernels.
$(VENV)/.mavproxy: $(VENV)/.installed
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps MAVProxy==1.8.75 || echo "warning: no MAVProxy" >&2
	@touch $@

$(VENV)/.warm: $(VENV)/.installed
	@$(BIN)/swath warmup || echo "warning: swath warmup failed: what is not compiled yet is compiled at first use" >&2
	@touch $@

demo: setup
	@$(BIN)/python examples/demo.py

test: setup
	$(PYTEST) -m "not soak" $(PARALLEL)

static: $(VENV)/.installed
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Compiling and reading the types take one core each for minutes: side by side.
check: $(VENV)/.installed
	$(MAKE) --no-print-directory --jobs 2 --output-sync=target setup static
	$(MAKE) --no-print-directory test

# Its last line is one JSON object: what the tests found, all of them together.
soak: setup
	@rm -f .soak-figures
	@outcome=0; SWATH_FIGURES=$(CURDIR)/.soak-figures $(PYTEST) -m soak || outcome=$$?; \
	$(BIN)/python -c 'import json, pathlib; p = pathlib.Path(".soak-figures"); found = {}; \
	[found.update(json.loads(line)) for line in (p.read_text().splitlines() if p.exists() else [])]; print(json.dumps(found))'; \
	rm -f .soak-figures; exit $$outcome

bench-%: setup
	@$(BIN)/python benchmarks/$*.py

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

deb: setup
	$(BIN)/python package/deb.py

release: setup
	$(BIN)/python package/release.py

bench: setup
	@$(BIN)/python benchmarks/all.py

clean:
	rm -rf $(VENV) build dist demo site *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
