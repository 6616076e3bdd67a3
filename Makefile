PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TUTORIALS := $(wildcard notebooks/[0-9]*.py)

.PHONY: install demo test slow gpu fuzz faults lint types notebooks docs bench clean

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "probmotion needs Python 3.11 or later, got $$($(PYTHON) --version 2>&1); set PYTHON=python3.11."; exit 1; }
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV) > /dev/null 2>&1 || \
		{ echo "$(PYTHON) cannot create a virtual environment; install its venv package (Debian: python3-venv)."; exit 1; }
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[test,lint,docs]'
	touch $@

demo: install
	@$(BIN)/probmotion compare gait gait-monocular --quick --draws 400 --workers 2 --out demo --report --figures \
		--samplers exact ancestral3d split-gibbs mvpc mas sds mh nuts tempered smc
	@$(BIN)/probmotion lift notebooks/keypoints/walk.json --image-size 1000 1000 --out demo/lift
	@$(BIN)/probmotion show demo/lift/lift.npz --figure demo/lift.png

# tests/test_extras.py runs tests/core, without the optional libraries.
test: install
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m 'not slow' -n 2 --dist worksteal \
		--ignore tests/core tests

slow: install
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m slow -n 2 --dist worksteal tests

# A million damaged files; "make test" reads ten thousand of them.
fuzz: install
	PROBMOTION_FUZZ=1000000 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
		$(BIN)/python -m pytest -n 2 --dist worksteal tests/fuzz

# On a machine with CUDA.
gpu: install
	$(BIN)/python -m pytest -m gpu tests

# Kills at 100 random moments of each program, Ctrl-C at 50; "make test" tries two. Full disks need root.
faults: install
	PROBMOTION_FAULTS=100 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
		$(BIN)/python -m pytest -n 2 --dist worksteal tests/faults

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# mypy reads the package as a wheel would hold it: samplers/ and models/ inside probmotion.
types: install
	rm -rf .types && mkdir -p .types
	cp -r probmotion .types/probmotion && cp -r samplers models .types/probmotion/
	cd .types && ../$(BIN)/mypy --config-file ../pyproject.toml -p probmotion

# Execute the tutorials whose script is newer than its executed copy.
notebooks: $(TUTORIALS:.py=.ipynb)

notebooks/%.ipynb: notebooks/%.py
	$(BIN)/python docs/_build_pages/execute_notebook.py $<

docs: install
	$(BIN)/python -m sphinx -W --keep-going -q -j 2 -b html docs docs/_build/html

# Writes docs/developer/benchmarks.md, on an idle machine. Some scripts: make bench SCRIPTS='lift.py mas.py'.
bench: install
	$(BIN)/python benchmarks/page.py $(SCRIPTS)

clean:
	rm -rf build .types demo docs/_build *.egg-info
