# Two commands do all set-up: `make demo` shows what this is for, `make test` checks it.
PYTHON ?= python3
BIN := .venv/bin
INSTALLED := .venv/.installed
# The same packages with the oldest Gymnasium that pyproject.toml declares; .venv has the newest.
OLDEST := .venv/oldest
OLDEST_GYMNASIUM := $(shell sed -n 's/.*"gymnasium>=\([0-9.]*\)".*/\1/p' pyproject.toml)
OLDEST_TESTS := tests/envs/test_checkers.py tests/envs/test_vector_contract.py \
	tests/envs/test_observation_ids.py tests/envs/test_constructors.py

.PHONY: demo test test-oldest check docs clean

demo: $(INSTALLED)
	$(BIN)/asp-env demo --out demo

test: $(INSTALLED)
	$(BIN)/pytest -n 2 --dist worksteal
	$(MAKE) test-oldest

test-oldest: $(OLDEST)/.installed
	$(OLDEST)/bin/python -m pytest -p no:cacheprovider -n 2 --dist worksteal $(OLDEST_TESTS)

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/pytest -n 2 --dist worksteal

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

clean:
	rm -rf .venv demo build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
