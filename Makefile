# Everything below works on a fresh machine with Python 3.11 or newer: the first target makes .venv and installs into it.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
ifndef SCENE  # the picture to start with: small, so that it is there within two minutes, compilation included
SIZE := --set camera.width=192 --set camera.height=192
endif
SCENE ?= experiments/scenes/cornell_fog.toml
BIN := .venv/bin
INSTALLED := .venv/.installed

.PHONY: install render pictures benchmark stress test test-slow lint clean

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@echo "installing into .venv (once; some minutes)"
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[dev]"
	touch $@

render: $(INSTALLED)  ## a fog-filled Cornell box (or SCENE=file.toml) by the methods that suit it, the reference beside it, into out/
	$(BIN)/jaxvol render $(SCENE) --method auto --beside path_tracing --samples 32 $(SIZE) --out out

pictures: $(INSTALLED)  ## the README's pictures; some ten minutes, goes on where it was stopped
	for scene in cornell_fog cloud plume; do \
		$(BIN)/jaxvol render experiments/scenes/$$scene.toml --samples 512 --out out/pictures || exit 1; \
		cp out/pictures/$$scene.png docs/images/; \
	done

benchmark: $(INSTALLED)  ## run time against error over five scenes: table, curves, plots into out/benchmark
	$(BIN)/jaxvol benchmark experiments/benchmark_small.toml --out out/benchmark

stress: $(INSTALLED)  ## 500 random scenes and the extremes through every method
	$(BIN)/jaxvol stress --out out/stress

test: $(INSTALLED)  ## the suite without its slow statistical part
	$(BIN)/python -m pytest -q -n 2 --dist loadfile

test-slow: $(INSTALLED)  ## the slow statistical part alone
	$(BIN)/python -m pytest -q -n 2 --dist loadfile -m slow

lint: $(INSTALLED)
	$(BIN)/ruff check .

clean:
	rm -rf .venv out
