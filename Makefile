# Two commands set everything up on a machine with Python >= 3.11 and make: make demo, make test.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo

.PHONY: demo test test-slow fuzz kill limits lint docs clean

$(VENV)/installed: pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[dev,model,cluster,docs,formats,mavlink,ros2]'
	touch $@

# 440 MB that only the tests of exports and of ROS 2 bags need.
$(VENV)/readers: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c requirements.lock -e '.[readers]'
	touch $@

# Simulated flights with exact truth, from video to fixes on board; two minutes of training are far too few
# for a network to be flown (half an hour is the default), and enough to see each step.
demo: $(VENV)/installed
	rm -rf $(DEMO)
	$(BIN)/spn-data simulate $(DEMO)/flights --preset demo --seed 1
	$(BIN)/spn-data reconstruct $(DEMO)/flights/mapping --area $(DEMO)/area --fov 72
	$(BIN)/spn-data register $(DEMO)/flights/evaluation/medium.mp4 --name medium --all-frames --area $(DEMO)/area
	$(BIN)/spn-data register $(DEMO)/flights/evaluation/low.mp4 --name low --expect-low --all-frames --area $(DEMO)/area
	$(BIN)/spn-data register --all-frames --area $(DEMO)/area
	$(BIN)/spn-data coverage --area $(DEMO)/area
	$(BIN)/spn-data split --area $(DEMO)/area
	$(BIN)/spn-data status --area $(DEMO)/area
	$(BIN)/python benchmarks/truth.py $(DEMO)/area $(DEMO)/flights
	$(BIN)/python benchmarks/labels.py $(DEMO)/area $(DEMO)/flights
	$(BIN)/spn-model train --area $(DEMO)/area --minutes 2 --validations 2
	$(BIN)/spn-model export --run default --area $(DEMO)/area
	$(BIN)/spn-model evaluate --run default --no-attitude --area $(DEMO)/area
	$(BIN)/spn-model benchmark --run default --area $(DEMO)/area
	$(BIN)/spn-onboard fly $(DEMO)/area/runs/default/bundle $(DEMO)/flights/evaluation/medium.mp4 \
		--camera $(DEMO)/area/4-eval/medium/camera.json --to $(DEMO)/fixes.jsonl
	$(BIN)/python tools/run_page.py docs/python.md

test: $(VENV)/readers
	$(BIN)/python -m pytest -m 'not slow' -n 2 --dist loadfile

test-slow: $(VENV)/readers
	$(BIN)/python -m pytest -m slow -n 2 --dist loadfile

# Mutated files through every reader, 12,000 of them in about ten minutes; failing ones stay in build/fuzz/failures.
fuzz: $(VENV)/installed
	PYTHONPATH=. $(BIN)/python -m fuzz --inputs 12000 --seconds 900

# Kills every command at up to 30 of its changes of files on a small area, reruns and compares; Linux and cc only.
kill: $(VENV)/installed
	PYTHONPATH=.:cli $(BIN)/python -m faults.kill

# Runs every command with a full disk, little memory and the like, and under signals; half an hour; needs to mount.
limits: $(VENV)/installed
	PYTHONPATH=.:cli $(BIN)/python -m faults.limits

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation site with the API reference, in build/site; warnings are errors.
docs: $(VENV)/installed
	$(BIN)/mkdocs build --strict --quiet

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info
