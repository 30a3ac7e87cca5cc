# make demo   train a walking Go1 on this CPU from the shipped PIDM, evaluate it, write pictures
# make test   everything CI runs but the smoke runs and the tests of optional packages
PYTHON ?= python3
BIN = .venv/bin

.PHONY: demo test

demo: .venv/installed
	$(BIN)/python ppo_finetune.py --task go1_loco --pretrained assets/pidm/go1.msgpack --run-dir runs/demo --force
	$(BIN)/python play.py runs/demo/policy.msgpack
	$(BIN)/python results/report.py --beside runs/demo

test: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	JAX_PLATFORMS=cpu $(BIN)/python -m pytest -q -n auto --dist loadfile --no-loadscope-reorder tests

.venv/installed: requirements.txt
	@$(PYTHON) -c "import sys; v = sys.version.split()[0]; (3, 11) <= sys.version_info[:2] <= (3, 13) or sys.exit( \
	  f'error: this needs Python 3.11 to 3.13, here is {v}; give another, as in make demo PYTHON=python3.12')"
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install -q -r requirements.txt
	touch $@
