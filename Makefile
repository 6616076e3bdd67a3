PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install demo test slow lint types bench clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test,lint]'
	touch $@

demo: install
	$(BIN)/probmotion compare gait gait-monocular --quick --workers 2 --out demo --pictures

test: install
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m 'not slow' -n 2 --dist worksteal tests

slow: install
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -n 2 --dist worksteal tests

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy reads the package as a wheel would hold it: samplers/ and models/ inside probmotion.
types: install
	rm -rf .types && mkdir -p .types
	cp -r probmotion .types/probmotion && cp -r samplers models .types/probmotion/
	cd .types && ../$(BIN)/mypy --config-file ../pyproject.toml -p probmotion

bench: install
	for script in benchmarks/*.py; do echo "# $$script"; $(BIN)/python $$script || exit 1; done

clean:
	rm -rf build .types demo *.egg-info
