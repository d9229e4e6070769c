# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# What is installed: enough for the demo (85 MB of wheels and a compiler's tools), or every extra and
# the tools of test and check (0.6 GB, torch's CPU build among them). And what is compiled.
DEMO   := $(VENV)/.installed-demo
FULL   := $(VENV)/.installed-test
BUILT  := $(VENV)/.built
# The versions and hashes of requirements/; LOCKED=0 takes what pyproject.toml permits instead.
LOCKED ?= 1
# A package index with CPU builds of PyTorch, for those whose default index brings CUDA packages.
TORCH_INDEX ?=
# Pythons that `make wheels` and `make test-wheels` use: all that are found, unless named.
PYTHONS ?=
NATIVE := $(shell find rfcore/csrc -type f 2>/dev/null) CMakeLists.txt

.DEFAULT_GOAL := help
.PHONY: help demo sample sample-field test test-slow test-slices test-scale test-aarch64 test-prometheus test-netns test-fault test-attack \
	test-compose test-system-packages drive-long stability check build bench proto figures images up \
	down load load-transport load-receiver load-full load-links load-overload soak soak-short \
	docs test-wheels build-full results results-full lock wheels nightly test-asan fuzz fuzz-nightly test-fault-core sizing

help:  ## show the targets
	@awk -F':.*## ' '/^[a-z%-]+:.*## / {printf "  make %-18s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: build  ## run the main job: two processes, one field, two drives; writes out/demo
	$(BIN)/rfedge demo

# So many processes run tests, each file as a whole in one of them; 0: all in this one, one by one.
WORKERS ?= $(shell nproc | awk '{print $$1 < 4 ? $$1 : 4}')
PARALLEL := -n $(WORKERS) --dist loadfile
test: build-full  ## run the fast tests (four minutes of two cores)
	$(BIN)/python -m pytest -m "not slow" $(PARALLEL)

test-slow: build-full test-system-packages  ## run the tests that take more than ten seconds each
	$(BIN)/python -m pytest -m "slow and not compose and not fault and not attack and not nightly" $(PARALLEL) --timeout 600

test-slices: build-full  ## compare a million macroblocks of the slice coder with FFmpeg; fuzz it and packets
	$(BIN)/python -m pytest tests/codec/test_slice_conformance.py tests/codec/test_mutations.py -m nightly --timeout 1800

test-scale: build-full  ## run each case of `rfedge-lab scale` once, small: Envoy, NATS, servers, their vehicles
	$(BIN)/python -m pytest tests/integration/test_envoy.py tests/integration/test_nats.py -m nightly --timeout 600

test-aarch64: build-full test-system-packages  ## build kernels for AArch64, emulate them, compare their bytes
	$(BIN)/python -m pytest tests/native -m nightly --timeout 900

# Debian packages that slow tests use beside Python: cross compiler and emulator for
# tests/native/test_aarch64_*.py, promtool and prometheus for tests/deploy, ip and tc for tests/link,
# OpenH264 for tests/codec/test_second_decoder.py, GStreamer's RTSP server for tests/agent/live,
# Chromium for tests/twin, bwrap for tests/server and tests/confinement, libseccomp for
# tests/confinement, nft for tests/fault, PoCL (OpenCL on the CPU) for tests/raster, NATS for
# tests/integration/test_nats.py. A test fails without its program, and says so. With LLVM, tests of
# the street render in a quarter of the time.
SYSTEM_PACKAGES := g++-aarch64-linux-gnu qemu-user prometheus iproute2 \
	gstreamer1.0-tools gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad \
	gstreamer1.0-plugins-ugly gir1.2-gst-rtsp-server-1.0 python3-gi bubblewrap libseccomp2 nftables \
	chromium chromium-driver pocl-opencl-icd nats-server libllvm19
SYSTEM_PROGRAMS := aarch64-linux-gnu-g++ qemu-aarch64 promtool prometheus ip tc gst-inspect-1.0 \
	bwrap nft chromium chromedriver nats-server
test-system-packages:  ## install the programs that test-slow uses (root, Debian)
	@if (for name in $(SYSTEM_PROGRAMS); do command -v $$name >/dev/null || exit 1; done) && \
		[ -e /etc/OpenCL/vendors/pocl.icd ] && ldconfig -p | grep -q 'libLLVM.*19'; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get -qq update && \
		DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends $(SYSTEM_PACKAGES); \
	else echo "slow tests need $(SYSTEM_PACKAGES), which root can install: some will fail"; fi

test-prometheus: build-full test-system-packages  ## test rules with promtool, and dashboards on a live run
	$(BIN)/python -m pytest -m prometheus --timeout 600

test-netns: build-full test-system-packages  ## compare the link with the kernel's own shaper (root)
	$(BIN)/python -m pytest -m netns --timeout 600

# RESUME=1: keep the rows that are there of this revision, and run what is missing. ONLY: of the cases
# that its words choose (pytest -k), as ONLY="a_lossy_link and 2Mbps".
CHOICE = $(if $(RESUME),--resume) $(if $(ONLY),-k "$(ONLY)")
test-fault: build-full test-system-packages  ## break servers, vehicles and links; writes lab/results/faults.json (root)
	$(BIN)/python -m pytest tests/fault -m fault --timeout 120 --faults-json lab/results/faults.json $(CHOICE)
	$(BIN)/python -m lab.pages.faults lab/results/faults.json > docs/reliability.md.part
	mv docs/reliability.md.part docs/reliability.md

test-attack: build-full test-system-packages  ## attack a server under compose's limits; writes lab/results/attacks.json (root)
	$(BIN)/python -m pytest tests/attack -m attack --timeout 180 --attacks-json lab/results/attacks.json $(CHOICE)
	$(BIN)/python -m lab.pages.attacks lab/results/attacks.json > docs/attacks.md.part
	mv docs/attacks.md.part docs/attacks.md

# The most telling ones: a server and a decoder that die, packets that are damaged, renders for nothing;
# on a small street, and at street size: the shipped field, 640x360. Chosen by a mark: where one
# fails, `.ci/run` has pytest choose among them what it runs again.
test-fault-core: build-full test-system-packages  ## the faults that CI injects on each push
	$(BIN)/python -m pytest tests/fault -m fault_core --timeout 120

# Scalar kernels under AddressSanitizer and UndefinedBehaviorSanitizer; one source serves them all.
ASAN := build/asan
ASAN_TESTS := tests/raster/test_native.py tests/raster/test_native_poison.py tests/ngp/test_native.py \
	tests/native/test_digest.py tests/native/test_light_grid.py tests/native/test_live_view.py tests/native/test_warp.py tests/native/test_yuv.py tests/codec/test_pcm_picture.py tests/codec/test_slice_conformance.py tests/fuzz
ASAN_PRELOAD = $(shell $(CXX) -print-file-name=libasan.so) $(shell $(CXX) -print-file-name=libstdc++.so)
test-asan: build-full  ## kernels and readers under sanitizers, a build of their own in build/asan
	$(BIN)/cmake -S . -B $(ASAN) -G Ninja -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python \
		-DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja -DCMAKE_CXX_FLAGS_RELEASE=-O1 \
		-DRFEDGE_SANITIZE=ON -DRFEDGE_SAMPLES=OFF > /dev/null
	$(BIN)/ninja -C $(ASAN) _native
	LD_PRELOAD="$(ASAN_PRELOAD)" ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
		$(BIN)/python tests/native/sanitized.py $(ASAN) -q -m "not slow" --timeout 250 \
		$(ASAN_TESTS)

SECONDS ?= 20
fuzz: build-full  ## SECONDS (20) of coverage-guided fuzzing of each reader (tests/fuzz)
	$(BIN)/python -m pip install -q --no-deps --require-hashes -r requirements/fuzz.txt
	PYTHONPATH=. $(BIN)/python tests/fuzz/fuzz.py $(SECONDS) $(TARGETS)

fuzz-nightly:  ## ten minutes of it for each reader
	$(MAKE) fuzz SECONDS=600

stability: build-full  ## run the hard cases; writes lab/results/stability.json and docs/stability.md
	$(BIN)/python -m pytest tests/hard/test_stability.py::test_the_case_holds \
		--stability-json lab/results/stability.json --stability-page docs/stability.md

test-compose: images  ## start docker-compose.yml and look at it (root, docker, docker-compose)
	$(BIN)/python -m pytest -m compose --timeout 1200

# Wheels are collected here where Python is the image's; else the build does it, which takes longer.
WHEELS_HERE = $(shell $(BIN)/python -c 'import sys; print(sys.version_info[:2] == (3, 11))')
images: build  ## build the images rfedge-runtime and rfedge-full
	@for image in runtime full; do \
		if [ "$(WHEELS_HERE)" = True ]; then \
			PYTHON=$(BIN)/python deploy/wheelhouse.sh $$image build/wheels/$$image; fi && \
		docker build -q --target $$image -t rfedge-$$image:local . || exit 1; done
	@docker image ls --format '{{.Repository}}:{{.Tag}} {{.Size}}' 'rfedge-*'

# STAND_IN=1: Debian's Prometheus and no Grafana, where no image registry can be reached.
COMPOSE_FILES := -f docker-compose.yml $(if $(STAND_IN),-f deploy/stand-in/docker-compose.yml)
COMPOSE = $(shell docker compose version >/dev/null 2>&1 && echo docker compose || echo docker-compose)
up:  ## start two roadside servers, four vehicles, Prometheus and Grafana in containers
	$(COMPOSE) $(COMPOSE_FILES) up -d
	@. ./.env && echo "dashboards  http://localhost:$$GRAFANA_PORT/dashboards" && \
		echo "Prometheus  http://localhost:$$PROMETHEUS_PORT/targets" && \
		echo "the street  http://localhost:$$TWIN_PORT/?token=$$TWIN_TOKEN"

down:  ## stop them and remove their volumes
	$(COMPOSE) $(COMPOSE_FILES) down -v

RUNS ?= 3
# A load NAME with OPTIONS: what was measured is recorded whether it was held or not.
load = rm -f out/loadtest/$(1)/result.json; \
	$(BIN)/rfedge loadtest --runs $(RUNS) --out out/loadtest/$(1) $(2); ended=$$?; \
	$(BIN)/python -m lab.pages.loads lab/results/loadtest.json out/loadtest/$(1)/result.json && exit $$ended
load: load-transport load-receiver load-full load-links load-overload  ## what two cores carry (`make -k load`, 8 min); writes lab/results/loadtest.json
load-transport: build-full  ## 100 streams at 30 Hz, pictures not decoded; writes lab/results/loadtest.json
	$(call load,transport,--mode transport --vehicles 100 --hz 30)
load-receiver: build-full  ## 8 vehicles at 10 Hz, decoded against cached renders; writes lab/results/loadtest.json
	$(call load,receiver,--mode receiver --vehicles 8 --hz 10)
load-full: build-full  ## 8 vehicles at 10 Hz, rendered and decoded; writes lab/results/loadtest.json
	$(call load,full,--mode full --vehicles 8 --hz 10)
load-links: build-full  ## 8 vehicles, each on a recorded link of its own; writes lab/results/loadtest.json
	$(call load,links,--mode receiver --vehicles 8 --hz 5 --link samples/links/drive.toml)
load-overload: build-full  ## twice of that load-full, admission on; writes lab/results/loadtest.json
	$(call load,overload,--mode full --vehicles 16 --hz 10 --admission)

MINUTES ?= 30
soak: build-full  ## half load for MINUTES (30): memory, descriptors and threads must not grow; writes lab/results/soak.json
	$(BIN)/python -m lab.soak --minutes $(MINUTES) $(ARGS); ended=$$?; \
		cp out/soak/soak.json lab/results/soak.json && exit $$ended

soak-short: build-full  ## three minutes of it
	$(BIN)/python -m lab.soak --minutes 3

sizing: build-full  ## measure the tables of `rfedge size` (ten minutes of two cores); then `make figures`
	$(BIN)/streetgen build samples/sizing/drive_1080p.toml --split drive --out out/drive-1080p
	$(BIN)/rfedge-lab size-tables vehicles@10=samples/street/transforms_drive_vehicles.json \
		vehicles@30=out/drive-1080p/transforms_drive.json --out rfedge/sizing/tables.json

check: build-full  ## lint, types, layers, generated files
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	@if npx --yes @bufbuild/buf --version >/dev/null 2>&1; then npx --yes @bufbuild/buf lint proto; \
		else echo "buf lint was not run: it needs node and its registry"; fi

sample: build-full  ## render the street in samples/street anew (half an hour)
	$(BIN)/streetgen build samples/street/empty.toml --split drive,train --out out/sample/empty
	$(BIN)/streetgen build samples/street/vehicles.toml --split drive --out out/sample/vehicles
	$(BIN)/python -m lab.make_street out/sample samples/street

drive-long: build-full  ## render 30 s of the sample's street at 10 Hz into out/drive-long (16 minutes of two cores)
	$(BIN)/streetgen build samples/localise/drive_30s.toml --split drive --out out/drive-long

sample-field: build-full  ## train the field that ships in samples/fields (some minutes)
	$(BIN)/python -m lab.sample_field samples/street $(ARGS)

bench: build-full  ## measure kernels and codec: correctness first, then time
	$(BIN)/rfedge-lab bench raster
	$(BIN)/rfedge-lab bench train
	$(BIN)/rfedge-lab bench codec

results results-full: build-full  ## record anew what takes two hours, or everything (lab/results/record.mk; DATA)
	$(MAKE) -f lab/results/record.mk $@ DATA=$(DATA) RFEDGE=$(BIN)/rfedge

results-%: build-full  ## record `rfedge eval NAME` in lab/results/NAME.json; options in ARGS (docs/explanation/evaluation.md)
	$(BIN)/rfedge eval $* $(ARGS) --out results/$*.json

figures: build-full  ## redraw docs/ from results/: figures, results.md, ladder.md
	$(BIN)/python -m lab.pages.results lab/results docs README.md
	$(BIN)/python -m rfedge.evaluate.ladder.page lab/results docs
	$(BIN)/python -m lab.pages.faults lab/results/faults.json > docs/reliability.md.part
	mv docs/reliability.md.part docs/reliability.md
	if test -f lab/results/attacks.json; then \
		$(BIN)/python -m lab.pages.attacks lab/results/attacks.json > docs/attacks.md.part && \
		mv docs/attacks.md.part docs/attacks.md; fi
	$(BIN)/python -m lab.pages.sizing > docs/sizing.md.part
	mv docs/sizing.md.part docs/sizing.md

docs: build-full  ## build the documentation site in build/site; a dead link is an error
	$(BIN)/python -m pip install -q --no-deps --require-hashes -r requirements/docs.txt
	$(BIN)/python docs/build_site.py

nightly:  ## what .ci/run leaves out: faults, wheels of every Python, half an hour of load, containers
	.ci/run nightly

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# The packages of a set, and nothing that they bring beside it when it is locked.
ifeq ($(LOCKED),1)
install = $(BIN)/python -m pip install -q --no-deps --require-hashes -r requirements/$(1).txt
else
install = $(BIN)/python deploy/requirements.py $(1) | grep -v ^torch= > $(VENV)/$(1).txt && \
	$(BIN)/python -m pip install -q -r $(VENV)/$(1).txt
endif

# After the locked packages, which are all it needs; before those that are not, which would choose for it.
torch = $(BIN)/python -m pip install -q $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX)) -r requirements/torch.txt

$(DEMO): pyproject.toml requirements/demo.txt | $(BIN)/python
	$(call install,demo)
	touch $@

$(FULL): pyproject.toml lab/pyproject.toml streetgen/pyproject.toml requirements/test.txt \
		requirements/torch.txt | $(DEMO)
	$(if $(filter 1,$(LOCKED)),,$(torch))
	$(call install,test)
	$(torch)
	$(BIN)/python -m pip install -q --no-build-isolation --no-deps -e streetgen -e lab
	touch $@

# An editable install does not rebuild C++ by itself; this does, incrementally, under build/.
$(BUILT): $(DEMO) $(NATIVE)
	$(BIN)/python -m pip install -q --no-build-isolation --no-deps -e .
	touch $@

build: $(BUILT)  ## set up .venv for the demo and compile the kernels

build-full: $(FULL) $(BUILT)  ## the same with every extra, streetgen and the lab, for tests and checks

lock: $(DEMO)  ## pin versions and hashes anew in requirements/ (Python 3.11)
	$(BIN)/python -m pip install -q "pip-tools>=7.5"
	PYTHON=$(BIN)/python deploy/lock.sh

wheels:  ## build the manylinux wheels into dist/: one for CPython 3.11, one for 3.12 and later
	$(PYTHON) deploy/wheels.py build $(PYTHONS)

test-wheels: wheels  ## try each CPython that is found in an empty venv: demo, and the bytes it encodes
	$(PYTHON) deploy/wheels.py test $(PYTHONS)

# The stubs are committed, so that installing needs no protoc; tests/wire/test_stubs.py sees drift.
STUBS ?= .
proto: $(FULL)  ## regenerate the gRPC stubs in rfcore/wire/v1
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m grpc_tools.protoc -I proto \
		--python_out=$(STUBS) --grpc_python_out=$(STUBS) --mypy_out=$(STUBS) \
		--mypy_grpc_out=$(STUBS) proto/rfcore/wire/v1/*.proto
