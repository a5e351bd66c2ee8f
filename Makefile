# heliomap. `make demo` maps the example plant and shows it; `make test` runs all tests; `make help` lists the rest.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
NPM ?= npm
CARGO ?= cargo

# ONNX Runtime comes from its Python wheel: a shared library of 29 MB, and no build.
ONNXRUNTIME_VERSION := 1.31.1
ORT_LIBRARY := .ort/libonnxruntime.so
export ORT_DYLIB_PATH ?= $(abspath $(ORT_LIBRARY))

# Folder of the data sets that are too large for the repository; tests that need one report that they skip without it.
HELIOMAP_DATA ?= $(abspath $(wildcard ../shared/data))
export HELIOMAP_DATA

.PHONY: help setup web demo test lint format deny unit page client kills disk-full tus contract query load scale-out tenants deploy-lint fuzz structure bench scaling yolo-export openapi configuration clean

help: ## List the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

# What reconstructs photos, COLMAP as a Python package.
RECONSTRUCT_PYTHON := .venv/reconstruct/bin/python
export HELIOMAP_RECONSTRUCT_PYTHON ?= $(abspath $(RECONSTRUCT_PYTHON))

setup: $(ORT_LIBRARY) web/dist/index.html .venv/reconstruct/done ## Fetch ONNX Runtime and pycolmap and build the web page, if missing

.venv/reconstruct/done: crates/photogrammetry/engine/requirements.txt
	@$(PYTHON) -m venv .venv/reconstruct && .venv/reconstruct/bin/pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

$(ORT_LIBRARY):
	@echo "fetching ONNX Runtime $(ONNXRUNTIME_VERSION)"
	@rm -rf .ort && mkdir -p .ort/wheel
	@$(PYTHON) -m pip download --quiet --disable-pip-version-check --no-deps --only-binary=:all: \
	  --dest .ort/wheel onnxruntime==$(ONNXRUNTIME_VERSION)
	@$(PYTHON) -m zipfile --extract .ort/wheel/*.whl .ort/wheel/unpacked
	@cp .ort/wheel/unpacked/onnxruntime/capi/libonnxruntime.so.* $(ORT_LIBRARY)
	@rm -rf .ort/wheel

web: web/dist/index.html ## Build the web page

web/dist/index.html: web/node_modules/done $(wildcard web/src/* web/src/*/* web/*.html web/vite.config.ts)
	@cd web && $(NPM) run build --silent

demo: setup ## Map the example plant through the HTTP service and check it (KEEP=1 leaves the service running)
	$(CARGO) build --release --locked
	$(PYTHON) examples/photos.py --binary target/release/heliomap
	$(PYTHON) examples/demo.py --binary target/release/heliomap $(if $(KEEP),--keep)

test: lint unit ## Run all tests

lint: .venv/lint/done web/node_modules/done ## Formatting and lints of Rust, Python and TypeScript; warnings are errors
	$(CARGO) fmt --all --check
	.venv/lint/bin/ruff check --quiet
	.venv/lint/bin/ruff format --check --quiet
	cd web && npx --no-install biome ci --colors=off --error-on-warnings
	$(PYTHON) .ci/dependencies.py
	$(PYTHON) .ci/links.py
	$(CARGO) clippy --locked --workspace --all-targets -- --deny warnings

format: .venv/lint/done web/node_modules/done ## Format Rust, Python and TypeScript, and apply the linters' safe fixes
	$(CARGO) fmt --all
	.venv/lint/bin/ruff check --fix --quiet
	.venv/lint/bin/ruff format --quiet
	cd web && npx --no-install biome check --write --colors=off

.venv/lint/done: .ci/requirements.txt
	@$(PYTHON) -m venv .venv/lint && .venv/lint/bin/pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

web/node_modules/done: web/package-lock.json
	@cd web && $(NPM) ci --no-audit --no-fund --loglevel=error
	@touch $@

CARGO_DENY_VERSION := 0.20.2
deny: .cargo-deny/bin/cargo-deny ## Check dependencies by deny.toml: advisories (needs a network), bans, licences, sources
	.cargo-deny/bin/cargo-deny --locked check

.cargo-deny/bin/cargo-deny:
	$(CARGO) install cargo-deny --version $(CARGO_DENY_VERSION) --locked --quiet --root .cargo-deny

# Tests that need Postgres, an S3-compatible server or pycolmap are ignored by plain `cargo test`; the servers are started here.
unit: setup .venv/s3/done ## Tests alone
	tests/with-postgres.sh tests/with-s3.sh bash -c '$(CARGO) test --locked --workspace && \
	  $(CARGO) test --locked --workspace --test store --test server --test engine -- --ignored'
	cd crates/photogrammetry/engine && PYTHONDONTWRITEBYTECODE=1 $(abspath $(RECONSTRUCT_PYTHON)) -m unittest --quiet
	$(MAKE) --no-print-directory page client

page: web/dist/index.html ## Use the web page in Chromium
	@command -v chromium >/dev/null || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends chromium >/dev/null; }
	cd web && $(NPM) run smoke --silent

client: setup ## The Python client and every command of docs/API.md against the real service
	@command -v jq >/dev/null || { apt-get update -qq && apt-get install -qq --yes --no-install-recommends jq >/dev/null; }
	$(CARGO) test --locked --no-run
	$(PYTHON) -m unittest discover --start-directory tests/clients

.venv/s3/done: tests/s3/requirements.txt
	@$(PYTHON) -m venv .venv/s3 && .venv/s3/bin/pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

KILLS ?= 200
kills: setup ## Kill server and worker at random KILLS times, half of them on Postgres; no data may be lost or differ
	$(CARGO) test --locked --no-run
	$(PYTHON) tests/kills/kills.py --binary target/debug/heliomap --kills $$(( $(KILLS) / 2 ))
	tests/with-postgres.sh bash -c '$(PYTHON) tests/kills/kills.py --binary target/debug/heliomap \
	  --kills $$(( $(KILLS) - $(KILLS) / 2 )) --seed 2 --database "$$HELIOMAP_TEST_POSTGRES/postgres"'

disk-full: setup ## Fill the disk of a service (tmpfs, needs root) and make room again; all must work by itself afterwards
	$(CARGO) test --locked --no-run
	$(PYTHON) tests/disk/full.py --binary target/debug/heliomap

tus: setup .venv/tus/done tests/tus/node_modules/done ## Upload 1 GB with two tus clients through 20 disconnects and a kill; compare the bytes
	$(CARGO) build --locked
	.venv/tus/bin/python tests/tus/tus.py --binary target/debug/heliomap

.venv/tus/done: tests/tus/requirements.txt
	@$(PYTHON) -m venv .venv/tus && .venv/tus/bin/pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

tests/tus/node_modules/done: tests/tus/package-lock.json
	@cd tests/tus && $(NPM) ci --no-audit --no-fund --loglevel=error
	@touch $@

contract: setup .venv/contract/done ## Run schemathesis with all checks on openapi.yaml against a real service
	$(CARGO) build --locked
	.venv/contract/bin/python tests/contract/contract.py

.venv/contract/done: tests/contract/requirements.txt
	@$(PYTHON) -m venv .venv/contract && .venv/contract/bin/pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

query: setup ## Measure dashboard queries on a plant of a million modules, on SQLite and on Postgres
	$(CARGO) build --release --locked
	HELIOMAP_BINARY=target/release/heliomap $(PYTHON) tests/query/query.py
	HELIOMAP_BINARY=target/release/heliomap tests/with-postgres.sh \
	  bash -c '$(PYTHON) tests/query/query.py --database "$$HELIOMAP_TEST_POSTGRES/postgres"'

load: setup ## Measure errors, response times and memory with 50 uploading clients and 200 dashboard requests per second
	$(CARGO) build --release --locked
	HELIOMAP_BINARY=target/release/heliomap $(PYTHON) tests/load/load.py

scale-out: setup .venv/s3/done ## Compare two workers with one, over Postgres and S3 in network namespaces; then cut one off
	$(CARGO) build --release --locked
	$(PYTHON) tests/scale/scale_out.py

tenants: setup ## Try every operation with the key of another organisation: every response must be 404
	$(CARGO) test --locked --test http tenants -- --nocapture

deploy-lint: .venv/deploy/done ## Lint the Dockerfile, compose.yaml and the Helm chart
	@.venv/deploy/bin/python deploy/lint.py

.venv/deploy/done: deploy/requirements.txt
	@$(PYTHON) -m venv .venv/deploy && .venv/deploy/bin/pip install --quiet --disable-pip-version-check --requirement $<
	@touch $@

# Needs nightly Rust and is a workspace of its own. New inputs go into a copy of the corpora.
CARGO_FUZZ_VERSION := 0.13.2
FUZZ_SECONDS ?= 600
FUZZ_TARGETS ?= ply reconstruction archive photo tus query
FUZZ_BOUNDS := -timeout=10 -rss_limit_mb=1024 -max_len=65536

fuzz: web .cargo-fuzz/bin/cargo-fuzz ## Fuzz every parser of untrusted input, FUZZ_SECONDS each: no crash, no hang, bounded memory
	@for target in $(FUZZ_TARGETS); do \
	  mkdir -p target/fuzz-corpus/$$target; \
	  PATH="$(CURDIR)/.cargo-fuzz/bin:$$PATH" $(CARGO) +nightly fuzz run $$target target/fuzz-corpus/$$target fuzz/corpus/$$target \
	    -- -max_total_time=$(FUZZ_SECONDS) $(FUZZ_BOUNDS) -print_final_stats=1; \
	done

.cargo-fuzz/bin/cargo-fuzz:
	@$(CARGO) install cargo-fuzz --version $(CARGO_FUZZ_VERSION) --locked --quiet --root .cargo-fuzz

structure: setup ## Map many simulated plants of every kind, on all cores; fails when too few are exact
	$(CARGO) test --release --locked --no-fail-fast --package heliomap-mapping --test structure -- --ignored --nocapture --test-threads 1

bench: setup ## Benchmarks of layout, locate, fusion and refinement
	$(CARGO) bench --locked --package heliomap-mapping --bench structure

scaling: setup ## Measure time and memory for plants of up to a million modules; plot in target/scaling
	$(CARGO) bench --locked --package heliomap-mapping --bench scaling

# Separate because the package and PyTorch are large. The package is under the AGPL, so nothing of it is kept.
ULTRALYTICS_VERSION := 8.4.190
YOLO_CHECK := target/yolo-export

yolo-export: setup ## Build and export an untrained network of the YOLOv8-seg family, and decode it
	rm -rf $(YOLO_CHECK) && mkdir -p $(YOLO_CHECK)
	$(PYTHON) -m venv $(YOLO_CHECK)/venv
	$(YOLO_CHECK)/venv/bin/pip install --quiet --disable-pip-version-check ultralytics==$(ULTRALYTICS_VERSION) onnx onnxruntime
	$(CARGO) build --locked
	cd $(YOLO_CHECK) && YOLO_CONFIG_DIR=. venv/bin/python $(CURDIR)/crates/mapping/tests/fixtures/detection/export_yolo.py \
	  $(CURDIR)/examples/plant/images/DJI_0001.jpg
	cd $(YOLO_CHECK) && for model in fixed.onnx dynamic.onnx; do \
	  $(CURDIR)/target/debug/heliomap detect photo.png --gsd 0.045 --detector $$model --out $$model.json; \
	  venv/bin/python $(CURDIR)/crates/mapping/tests/fixtures/detection/check_yolo.py $$model $$model.json; \
	done
	rm -rf $(YOLO_CHECK)

openapi: ## Regenerate openapi.yaml from the code
	$(CARGO) run --locked --quiet -- openapi > openapi.yaml.new && mv openapi.yaml.new openapi.yaml

configuration: ## Regenerate docs/CONFIGURATION.md from the command line
	$(CARGO) run --locked --quiet -- configuration > CONFIGURATION.md.new && mv CONFIGURATION.md.new docs/CONFIGURATION.md

clean: ## Remove all build outputs and fetched files
	rm -rf target .ort .venv .cargo-deny .cargo-fuzz fuzz/target web/dist web/node_modules tests/tus/node_modules
