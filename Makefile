# `make demo` and `make test` need only Python 3.11+, make and a network connection: tools/setup.sh does the rest.
BIN := .venv/bin
export MUJOCO_GL ?= egl

.PHONY: help setup demo check test test-pythons measure-tests blender extension docs assets page lock clean bench-export bench-integrators bench-order bench-planning bench-live bench-unseen bench-collocation bench-growth bench-peers audit-random hostile-files

help:
	@echo "make demo               export examples/canyon_flight.toml to out/: a USD shot, frames and a film"
	@echo "make test               run the formatter, the linter, the type checker and all tests"
	@echo "make check              the same with the fast tests only: under a minute of CPU"
	@echo "make test-pythons       run all tests on Python 3.11 and 3.13, and the core on 3.12 and 3.14, where available"
	@echo "make measure-tests      run all tests and record the time of each, from which make check selects"
	@echo "make setup              create .venv from locked dependencies"
	@echo "make blender            install Blender's Python module in .blender (400 MB), so that its tests run too; another version: BLENDER_PYTHON=python3.13 BPY=5.3.0"
	@echo "make extension          build the extension for Blender: build/vehsim-<version>.zip"
	@echo "make docs               generate the key tables of docs/shot-file.md, and the site in site/"
	@echo "make assets             generate the vehicles' USD assets; the bytes are the same on every machine"
	@echo "make page               bundle three.js for the pages that show a shot in a browser, and for a test; needs npm"
	@echo "make lock               update requirements.lock from pyproject.toml"
	@echo "make bench-integrators  measure the claims of the papers; writes benchmarks/RESULTS.md"
	@echo "make bench-order        free bodies: CPU time to a given error, against RK4; writes RESULTS.order.md (two minutes)"
	@echo "make bench-planning     measure plans: building, free space, canyon, replanning; writes RESULTS.planning.md"
	@echo "make bench-live         drag marks of live sessions through the protocol, and open the examples; writes RESULTS.live.md, RESULTS.openings.md"
	@echo "make bench-unseen       plan 1,600 random problems: the share certified, and why the others failed (hours; resumes)"
	@echo "make bench-collocation  compare DMOC with collocation; writes RESULTS.collocation.md"
	@echo "make bench-peers        plan beside Drake and CasADi; writes RESULTS.peers.md (six minutes)"
	@echo "make bench-growth       measure how CPU time and memory grow with frames, clips, vehicles, segments and obstacles"
	@echo "make bench-export       compare baking, pictures and batches with alternatives (ten minutes)"
	@echo "make audit-random       export a thousand random shots and measure them from USD alone (hours; resumes)"
	@echo "make hostile-files      give 20,000 broken or hostile files to all commands (hours; resumes)"
	@echo "make clean              remove everything that the other commands made"

setup:
	@sh tools/setup.sh

demo: setup
	$(BIN)/vehsim export examples/canyon_flight.toml --out out --to usd,png,mp4,npz,csv,html

test: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	rm -rf .cache # results that older code has cached prove nothing
	VEHSIM_CACHE="$(CURDIR)/.cache" $(BIN)/pytest -n 2 --dist worksteal

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/pytest -q --fast

test-pythons: setup
	sh tools/test_pythons.sh

measure-tests: setup
	$(BIN)/pytest -n 2 --dist worksteal --measure

BLENDER_PYTHON ?= python3.11
BPY ?= 5.0.1

blender:
	$(BLENDER_PYTHON) -m venv .blender
	.blender/bin/python -m pip install --quiet bpy==$(BPY)

extension: setup
	$(BIN)/python tools/build_extension.py build

docs: setup
	$(BIN)/python -m vehsim.shot.reference docs/shot-file.md docs/character.md
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

assets: setup
	$(BIN)/python -m vehsim.assets.generate

page: # needs npm
	cd tools/page && npm install --silent --no-audit --no-fund --no-package-lock
	cd tools/page && npx esbuild three.js --bundle --minify --format=iife --global-name=THREE --legal-comments=inline \
		--charset=utf8 --outfile=../../exporters/web/page/three.min.js
	cd tools/page && npx esbuild gltf.js --bundle --minify --format=iife --global-name=GLTF --legal-comments=inline \
		--charset=utf8 --outfile=../../tests/exporters/gltf.min.js
	cp tools/page/node_modules/three/LICENSE exporters/web/page/three.LICENSE.txt

lock: setup
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --extra dev --extra docs \
		--custom-compile-command "make lock" --output-file requirements.lock pyproject.toml

bench-order: setup
	$(BIN)/python -m benchmarks.order

bench-integrators: setup
	$(BIN)/python -m benchmarks.integrators

bench-planning: setup
	$(BIN)/python -m benchmarks.planning

bench-live: setup
	$(BIN)/python -m benchmarks.live
	$(BIN)/python -m benchmarks.openings

bench-unseen: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'ompl>=2,<3'
	$(BIN)/python -m benchmarks.unseen $(if $(SEEDS),--seeds $(SEEDS))

bench-collocation: setup
	$(BIN)/python -m benchmarks.collocation

bench-peers: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'drake>=1.40,<2'
	$(BIN)/python -m benchmarks.peers

bench-growth: setup
	$(BIN)/python -m benchmarks.growth

bench-export: setup
	$(BIN)/python benchmarks/bench_export.py

audit-random: setup
	$(BIN)/python -m tools.audit_random --seeds $(or $(SEEDS),0-999) --out $(or $(OUT),out/audit_random)

hostile-files: setup
	$(BIN)/python -m tools.hostile_files --seeds $(or $(SEEDS),0-19999) --out $(or $(OUT),out/hostile_files) $(if $(SEEDS),,--page benchmarks/RESULTS.hostile.md)

clean:
	rm -rf .venv .cache .pythons .blender out site build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
