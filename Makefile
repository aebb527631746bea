# Two commands do all set-up: `make demo` shows what this is for, `make test` checks it.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed
SMOKE := .venv/smoke
# The same packages with the oldest Gymnasium that pyproject.toml declares; .venv has the newest.
OLDEST := .venv/oldest
OLDEST_GYMNASIUM := $(shell sed -n 's/.*"gymnasium>=\([0-9.]*\)".*/\1/p' pyproject.toml)
# Tools that look at .venv from outside of it.
AUDIT := .venv/audit
OLDEST_TESTS := tests/envs/test_checkers.py tests/envs/test_vector_contract.py \
	tests/envs/test_observation_ids.py tests/envs/test_constructors.py
# Mutation testing (docs/mutation.md), and which mutants are tested: the default is a tenth of them,
# those whose number within a function ends with 7; MUTANTS='*' is all.
MUTMUT := mutmut==3.8.1
MUTANTS ?= *__mutmut_*7
MUTATED := build/mutation

.PHONY: demo test test-oldest smoke check docs mutants soak campaign crash-campaign sbom audit clean

demo: $(INSTALLED)
	$(BIN)/asp-env demo --out demo

test: $(INSTALLED)
	$(BIN)/pytest -n 2 --dist worksteal
	$(MAKE) test-oldest

test-oldest: $(OLDEST)/.installed
	$(OLDEST)/bin/python -m pytest -p no:cacheprovider -n 2 --dist worksteal $(OLDEST_TESTS)

# The core without torch, with another PYTHON in an environment of its own.
smoke:
	rm -rf $(SMOKE)
	$(PYTHON) -m venv $(SMOKE)
	$(SMOKE)/bin/pip install --quiet --disable-pip-version-check --constraint constraints.txt '.[report]'
	cd $(SMOKE) && bin/python -P $(CURDIR)/tests/smoke.py

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/pytest -n 2 --dist worksteal

# An hour: memory, open files, threads and processes stay flat. Writes soak/soak.csv and soak/soak.png.
soak: $(INSTALLED)
	$(BIN)/python -m tests.benchmarks.soak

# A copy without the decorators of kernels: mutmut skips decorated functions, and NUMBA_DISABLE_JIT
# leaves no compiled or cached code that a mutant could not reach.
mutants: .venv/mutmut/.installed
	mkdir -p $(MUTATED)
	git ls-files -z asp_env policies predictors scenarios tests pyproject.toml \
	| xargs -0 cp --parents --preserve=timestamps --target-directory=$(MUTATED)
	find $(MUTATED)/asp_env -name '*.py' -exec \
	sed -i -E '/^@(njit\(.*\)|no_type_check)$$/d' {} +
	cd $(MUTATED) && set -f && NUMBA_DISABLE_JIT=1 OMP_NUM_THREADS=1 \
	$(CURDIR)/.venv/mutmut/bin/mutmut run --max-children 2 $(MUTANTS)
	cd $(MUTATED) && $(CURDIR)/.venv/mutmut/bin/mutmut results | grep -v ': not checked' || true

# 5,000 damaged inputs of each format; hours, see docs/robustness.md.
campaign: $(INSTALLED)
	$(BIN)/python -m tests.campaigns

# The site is in build/site; warnings are errors.
docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

$(INSTALLED): pyproject.toml constraints.txt
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	touch $(INSTALLED)

# Its own packages come first on its path, those of .venv after them.
$(OLDEST)/.installed: $(INSTALLED)
	rm -rf $(OLDEST)
	$(BIN)/python -m venv --without-pip $(OLDEST)
	$(BIN)/python -c "import sysconfig, pathlib; \
	pathlib.Path(sysconfig.get_path('purelib', vars={'base': '$(CURDIR)/$(OLDEST)'}), 'newest.pth') \
	.write_text('import site; site.addsitedir(%r)' % sysconfig.get_path('purelib'))"
	$(BIN)/pip --python $(OLDEST)/bin/python install --quiet --disable-pip-version-check \
	--no-deps 'gymnasium==$(OLDEST_GYMNASIUM)'
	touch $@

# Kills commands at random moments, and compares what their reruns write: about ten CPU minutes.
crash-campaign: $(INSTALLED)
	$(BIN)/python -m tests.campaigns.crashes

# Lists what is installed in .venv, in CycloneDX's format, in sbom.json.
sbom: $(AUDIT)/.installed
	$(AUDIT)/bin/cyclonedx-py environment --output-reproducible --pyproject pyproject.toml \
	--output-file sbom.json $(BIN)/python

# Compares the pinned packages with the known vulnerabilities; needs pypi.org, not a mirror of it.
audit: $(AUDIT)/.installed
	$(AUDIT)/bin/pip-audit --requirement constraints.txt --no-deps --disable-pip --strict

$(AUDIT)/.installed: $(INSTALLED)
	rm -rf $(AUDIT)
	$(PYTHON) -m venv $(AUDIT)
	$(AUDIT)/bin/pip install --quiet --disable-pip-version-check cyclonedx-bom pip-audit

# Its own packages come first on its path, those of .venv after them.
.venv/mutmut/.installed: $(INSTALLED)
	rm -rf .venv/mutmut
	$(PYTHON) -m venv .venv/mutmut
	.venv/mutmut/bin/pip install --quiet --disable-pip-version-check --constraint constraints.txt \
	'$(MUTMUT)'
	.venv/mutmut/bin/python -c "import sysconfig, pathlib; \
	pathlib.Path(sysconfig.get_path('purelib'), 'project.pth') \
	.write_text('import site; site.addsitedir(%r)' % sysconfig.get_path('purelib', vars={'base': '$(CURDIR)/.venv'}))"
	touch $@

clean:
	rm -rf .venv demo build dist soak sbom.json *.egg-info .pytest_cache .ruff_cache .hypothesis
