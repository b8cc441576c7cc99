# `make demo` and `make test` need nothing but Python 3.11+, make and the network: tools/setup.sh does the rest.
BIN := .venv/bin
export MUJOCO_GL ?= egl

.PHONY: help setup demo check test test-pythons measure-tests blender docs assets lock clean bench-export bench-integrators bench-planning bench-collocation audit-random

help:
	@echo "make demo   export examples/canyon_flight.toml to out/: a USD shot, frames and a film"
	@echo "make test   formatter, linter, type checker and all tests"
	@echo "make check  formatter, linter, type checker and the cheapest tests: under a minute of CPU"
	@echo "make test-pythons  all tests on Python 3.11 and 3.13, the core on 3.12 and 3.14, as far as they can be had"
	@echo "make measure-tests  all tests, and write what each takes, by which make check chooses"
	@echo "make blender  Blender's Python module in .blender (400 MB), so that its tests run too"
	@echo "make setup  only make .venv"
	@echo "make docs   the key tables of docs/shot-file.md, and the site in site/"
	@echo "make assets regenerate the vehicles' USD assets; the same bytes on every machine"
	@echo "make lock   bring requirements.lock up to date with pyproject.toml"
	@echo "make bench-integrators  the claims of the papers, measured; writes benchmarks/RESULTS.md"
	@echo "make bench-planning  plans measured: building, free space, canyon, replanning; writes RESULTS.planning.md"
	@echo "make bench-collocation  DMOC against collocation; writes RESULTS.collocation.md"
	@echo "make bench-export  measure baking, pictures and batches beside their peers (ten minutes)"
	@echo "make audit-random  a thousand random shots, measured from USD alone (hours; goes on where it stopped)"
	@echo "make clean  remove what the other commands made"

setup:
	@sh tools/setup.sh

demo: setup
	$(BIN)/vehsim export examples/canyon_flight.toml --out out --to usd,png,mp4,npz,csv

test: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2 --dist worksteal

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest -q --fast

test-pythons: setup
	sh tools/test_pythons.sh

measure-tests: setup
	$(BIN)/pytest -n 2 --dist worksteal --measure

blender:
	python3.11 -m venv .blender
	.blender/bin/python -m pip install --quiet bpy==5.0.1

docs: setup
	$(BIN)/python -m vehsim.shot.reference docs/shot-file.md
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

assets: setup
	$(BIN)/python -m vehsim.assets.generate

lock: setup
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --extra dev --extra docs \
		--custom-compile-command "make lock" --output-file requirements.lock pyproject.toml

bench-integrators: setup
	$(BIN)/python -m benchmarks.integrators

bench-planning: setup
	$(BIN)/python -m benchmarks.planning

bench-collocation: setup
	$(BIN)/python -m benchmarks.collocation

bench-export: setup
	$(BIN)/python benchmarks/bench_export.py

audit-random: setup
	$(BIN)/python -m tools.audit_random --seeds $(or $(SEEDS),0-999) --out $(or $(OUT),out/audit_random)

clean:
	rm -rf .venv .pythons .blender out site build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
