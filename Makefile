# Two commands set everything up on a machine with Python 3.11 or newer and make: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# The environment's Python with OpenCV 4, which lies in a folder of its own, before the newer one.
OPENCV4 := PYTHONPATH=$(abspath $(VENV)/opencv4) nice -n 10 $(BIN)/python
# pip writes no bytecode where it builds the package (13 s of a processor): most of it is never imported.
export PIP_COMPILE := 0
# For the tests uv installs, in a fifth of pip's processor time; pip does where uv cannot.
UV := $(BIN)/uv pip install --quiet --python $(BIN)/python
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check
# Python writes it for what is imported: without it each of a hundred processes compiles its imports again, for 3 s and more.
unexport PYTHONDONTWRITEBYTECODE
# As the commands set it: OpenBLAS's threads wait for each other at every small matrix, which tests in parallel pay for.
export OPENBLAS_NUM_THREADS ?= 1
# A file is one worker's; files in their order, which begins with the longest.
PARALLEL := -n 3 --dist=loadfile --no-loadscope-reorder

.PHONY: demo test pytest opencv4 lint style types docs bench clean

demo: $(VENV)/.armsight  ## the whole experiment in the simulated workcell, held against its truth
	$(BIN)/armsight demo -o demo

test: $(VENV)/.armsight-test style  ## everything that must hold
	$(BIN)/python -m armsight.kernels.build
	+$(MAKE) --no-print-directory --jobs=2 pytest types opencv4

# Imported once before, so that bytecode is compiled once and not by each worker: 17 s of a processor for each.
pytest:
	$(BIN)/python -m pytest --collect-only --quiet -o python_functions=none > /dev/null || true  # what fails here fails below
	$(BIN)/python -m pytest $(PARALLEL)

# Beside the others, once types are checked.
opencv4: $(VENV)/.armsight-test $(VENV)/.opencv4
	$(OPENCV4) -c "import cv2; assert cv2.__version__.startswith('4.'), cv2.__version__"
	$(OPENCV4) -m pytest -m opencv $$(grep -rl --include="test_*.py" "pytest.mark.opencv" tests)

lint: style types

style: $(VENV)/.armsight-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# A minute of one processor: beside the tests, where they leave one free.
types: $(VENV)/.armsight-test
	nice -n 10 $(BIN)/mypy

docs: $(VENV)/.armsight-test  ## the site, into docs/_build/html; runs the tutorials and the examples where they changed
	$(BIN)/python docs/run_tutorials.py docs/_made
	$(BIN)/python -m sphinx -W --keep-going -n -q -j auto -D plot_gallery=1 docs docs/_build/html

# Fewer repetitions than a script makes alone: docs/measured.md names the command of each table.
SCRIPTS := calibration.py "markers.py --fixed-only" "kinematics.py 100000" motions.py "board.py 1000" dense.py identify.py \
	"experiment.py 3 quick" "health.py --seeds 2100:2102" speed.py "digits.py ratio"

bench: $(VENV)/.armsight-test  ## every figure, peers beside, ends with 1 where a ratio of times is worse than the last release's; real recordings are looked for at ARMSIGHT_DATA
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e ".[bench]"
	cd benchmarks && for each in $(SCRIPTS); do echo "== $$each"; ../$(BIN)/python $$each || exit 1; done

# The firmware is built with the package, with zig from PyPI; ARMSIGHT_FIRMWARE_COMPILER=gcc asks for arm-none-eabi-gcc.
$(VENV)/.armsight: pyproject.toml setup.py $(shell find firmware -type f)
	@echo "installs packages, compiles kernels and firmware: some minutes without a word"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --compile --disable-pip-version-check -e ".[sim,record]"
	touch $@

# What builds the package, in a folder of its own: pip would install its 600 MB once to build and once to stay. The setuptools
# that came with the environment is older, and would be found first.
$(VENV)/.build: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	rm -rf $(VENV)/build  # else pip would find the setuptools there, and remove that
	$(BIN)/python -m pip uninstall --quiet --yes setuptools
	$(PIP) uv || true
	requires=$$($(BIN)/python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['build-system']['requires'])"); \
		$(UV) --target $(VENV)/build $$requires || $(PIP) --upgrade --target $(VENV)/build $$requires
	$(BIN)/python -c "import site; print('$(abspath $(VENV)/build)', file=open(site.getsitepackages()[0] + '/build.pth', 'w'))"
	touch $@

# Kernels and firmware are compiled while pip unpacks all else, of which they need nothing.
$(VENV)/.armsight-test: $(VENV)/.build setup.py $(shell find firmware -type f)
	+$(MAKE) --no-print-directory --jobs=2 packages native $(VENV)/.opencv4
	touch $(VENV)/.armsight $@

.PHONY: packages native
packages:
	ARMSIGHT_NATIVE=later $(UV) -e ".[test]" || \
		PYTHONPATH=$(abspath $(VENV)/build) ARMSIGHT_NATIVE=later $(PIP) --no-build-isolation -e ".[test]"

native:
	PYTHONPATH=src:$(abspath $(VENV)/build) $(BIN)/python -S -m armsight.kernels.build
	PYTHONPATH=src:$(abspath $(VENV)/build) $(BIN)/python -S -m armsight.firmware.build

$(VENV)/.opencv4: $(VENV)/.build
	$(UV) --no-deps --target $(VENV)/opencv4 "opencv-python-headless<5" || \
		$(PIP) --no-deps --upgrade --target $(VENV)/opencv4 "opencv-python-headless<5"
	touch $@

clean:
	rm -rf $(VENV) demo build src/armsight/firmware/built .pytest_cache .mypy_cache .ruff_cache .hypothesis
