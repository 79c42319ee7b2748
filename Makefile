# beamsplat: `make demo` sets up and shows it at work, `make test` sets up and runs the tests.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out/demo
STAMP := $(VENV)/.installed

.PHONY: setup web demo test slow soak bench bench-slam lint docs clean

setup: $(STAMP)

# On Linux x86-64 the plain torch wheel brings gigabytes of CUDA. Without an NVIDIA GPU the CPU build is
# taken instead: from the configured index if that has it, else from PyTorch's own.
TORCH := torch==2.13.0
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "BeamSplat needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --upgrade pip
	@if command -v nvidia-smi >/dev/null || [ "$$(uname -sm)" != "Linux x86_64" ]; then \
		$(BIN)/pip install -q $(TORCH); \
	else \
		$(BIN)/pip install -q $(TORCH)+cpu 2>/dev/null \
			|| $(BIN)/pip install -q --index-url $(TORCH_CPU_INDEX) $(TORCH); \
	fi
	$(BIN)/pip install -q -c constraints.txt -e '.[all]'
	$(BIN)/beamsplat warm
	@sh web/build.sh $(BIN) || true
	touch $@

# The 3D viewer of the page, from web/ to services/page/static/viewer/; set-up does it once, where npm packages can be had.
web: setup
	@sh web/build.sh $(BIN)

demo: setup
	$(BIN)/beamsplat demo --out $(OUT)

test: setup
	$(BIN)/python -m pytest -m "not live and not soak and not slow" -n auto --maxprocesses 4 --dist loadfile
	# Tests of live systems wait more than they compute.
	$(BIN)/python -m pytest -m "live and not soak and not slow" -n 3 --dist loadfile --durations=12

# Whole drives and whole systems, minutes in all; most of them need recordings with truth.
slow: setup
	$(BIN)/python -m pytest -m slow

soak: setup
	$(BIN)/python -m pytest -m soak

bench: setup
	$(BIN)/beamsplat bench bus

# The table in the README: DATA holds X.bag beside X.relations, or bag/ beside groundtruth.txt. Then large
# simulated floors: out/sites/table.md.
bench-slam: setup
	$(BIN)/beamsplat bench slam --data $(DATA) --out out/slam --readme README.md --pictures docs/slam_maps.jpg
	$(BIN)/beamsplat bench sites --out out/sites

# The package as one folder of links: tools that read sources cannot follow an editable install.
TYPED := build/typed

lint: setup $(TYPED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@if [ -x web/node_modules/.bin/tsc ]; then cd web && node_modules/.bin/tsc --project tsconfig.json; fi

$(TYPED):
	mkdir -p $@/beamsplat
	ln -sfn ../../../tools/api/__init__.py ../../../tools/api/__main__.py $@/beamsplat
	ln -sfn ../../../tools/api/py.typed ../../../common ../../../services ../../../tools ../../../deploy $@/beamsplat

# The documentation site in build/site; its reference pages are generated from the code by docs/hooks.py.
docs: setup $(TYPED)
	NO_MKDOCS_2_WARNING=true $(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) out build .numba_cache web/node_modules services/page/static/viewer
