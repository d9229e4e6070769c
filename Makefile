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
.PHONY: help help-lab demo build build-full test check docs test-slow test-slices test-scale \
	test-aarch64 test-fault test-fault-core test-attack test-asan test-compose test-wheels \
	test-system-packages fuzz fuzz-nightly nightly wheels images up down lock proto

# A line `##@ TOPIC` heads the targets after it.
topics = awk -F':.*\#\# ' '/^\#\#@ / {print "\n" substr($$0, 5)} \
	/^[a-z0-9 %-]+:.*\#\# / {printf "  make %-20s %s\n", $$1, $$2}'
##@ To begin
help:  ## show these targets
	@$(topics) Makefile

help-lab:  ## show the targets that measure and record
	@$(topics) lab/targets.mk

demo: build  ## run the main job: two processes, one field, two drives
	$(BIN)/rfedge demo

build: $(BUILT)  ## set up .venv for the demo and compile the kernels

build-full: $(FULL) $(BUILT)  ## the same with every extra, streetgen and the lab

##@ Before each commit
# So many processes run tests, each file as a whole in one of them; 0: all in this one, one by one.
WORKERS ?= $(shell nproc | awk '{print $$1 < 4 ? $$1 : 4}')
PARALLEL := -n $(WORKERS) --dist loadfile
test: build-full  ## run the fast tests (four minutes of two cores)
	$(BIN)/python -m pytest -m "not slow" $(PARALLEL)

check: build-full  ## lint, types, layers, generated files
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	@if npx --yes @bufbuild/buf --version >/dev/null 2>&1; then npx --yes @bufbuild/buf lint proto; \
		else echo "buf lint was not run: it needs node and its registry"; fi

docs: build-full  ## build the documentation in build/site; a dead link is an error
	$(BIN)/python -m pip install -q --no-deps --require-hashes -r requirements/docs.txt
	$(BIN)/python docs/build_site.py

##@ Longer tests
test-slow: build-full test-system-packages  ## tests that take more than ten seconds each
	$(BIN)/python -m pytest -m "slow and not compose and not fault and not attack and not nightly" \
		$(PARALLEL) --timeout 600

# Debian packages that slow tests use beside Python: cross compiler and emulator for
# tests/native/test_aarch64_*.py, promtool and prometheus for tests/deploy, ip and tc for tests/link,
# OpenH264 for tests/codec/test_second_decoder.py, GStreamer's RTSP server for tests/agent/live,
# Chromium for tests/twin, bwrap for tests/server and tests/confinement, libseccomp for
# tests/confinement, nft for tests/fault, PoCL (OpenCL on the CPU) for tests/raster, NATS for
# tests/integration/test_nats.py, gpsd for tests/agent/pose_feed. A test fails without its program, and says so. With LLVM, tests of
# the street render in a quarter of the time.
SYSTEM_PACKAGES := g++-aarch64-linux-gnu qemu-user prometheus iproute2 \
	gstreamer1.0-tools gstreamer1.0-plugins-base gstreamer1.0-plugins-good gstreamer1.0-plugins-bad \
	gstreamer1.0-plugins-ugly gir1.2-gst-rtsp-server-1.0 python3-gi bubblewrap libseccomp2 nftables \
	chromium chromium-driver pocl-opencl-icd nats-server libllvm19 gpsd
SYSTEM_PROGRAMS := aarch64-linux-gnu-g++ qemu-aarch64 promtool prometheus ip tc gst-inspect-1.0 \
	bwrap nft chromium chromedriver nats-server /usr/sbin/gpsd
test-system-packages:  ## install the programs that test-slow uses (root, Debian)
	@if (for name in $(SYSTEM_PROGRAMS); do command -v $$name >/dev/null || exit 1; done) && \
		[ -e /etc/OpenCL/vendors/pocl.icd ] && ldconfig -p | grep -q 'libLLVM.*19'; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		apt-get -qq update && \
		DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends $(SYSTEM_PACKAGES); \
	else echo "slow tests need $(SYSTEM_PACKAGES), which root can install: some will fail"; fi

# RESUME=1: keep the rows that are there of this revision, and run what is missing. ONLY: of the cases
# that its words choose (pytest -k), as ONLY="a_lossy_link and 2Mbps".
CHOICE = $(if $(RESUME),--resume) $(if $(ONLY),-k "$(ONLY)")
test-fault: build-full test-system-packages  ## break servers, vehicles and links; records it (root)
	$(BIN)/python -m pytest tests/fault -m fault --timeout 120 --faults-json lab/results/faults.json $(CHOICE)
	$(MAKE) figures

test-attack: build-full test-system-packages  ## attack a server under compose's limits; records it (root)
	$(BIN)/python -m pytest tests/attack -m attack --timeout 180 --attacks-json lab/results/attacks.json $(CHOICE)
	$(MAKE) figures

# The most telling ones: a server and a decoder that die, packets that are damaged, renders for nothing;
# on a small street, and at street size: the shipped field, 640x360. Chosen by a mark: where one
# fails, `.ci/run` has pytest choose among them what it runs again.
test-fault-core: build-full test-system-packages  ## the faults that CI injects on each push
	$(BIN)/python -m pytest tests/fault -m fault_core --timeout 120

# Scalar kernels under AddressSanitizer and UndefinedBehaviorSanitizer; one source serves them all.
ASAN := build/asan
ASAN_TESTS := tests/raster/test_native.py tests/raster/test_native_poison.py tests/ngp/test_native.py \
	tests/native/test_light_grid.py tests/native/test_live_view.py tests/native/test_warp.py tests/native/test_yuv.py tests/codec/test_pcm_picture.py tests/codec/test_slice_conformance.py tests/fuzz
ASAN_PRELOAD = $(shell $(CXX) -print-file-name=libasan.so) $(shell $(CXX) -print-file-name=libstdc++.so)
test-asan: build-full  ## kernels and readers under sanitizers
	$(BIN)/cmake -S . -B $(ASAN) -G Ninja -DPython_EXECUTABLE=$(CURDIR)/$(BIN)/python \
		-DCMAKE_MAKE_PROGRAM=$(CURDIR)/$(BIN)/ninja -DCMAKE_CXX_FLAGS_RELEASE=-O1 \
		-DRFEDGE_SANITIZE=ON -DRFEDGE_SAMPLES=OFF > /dev/null
	$(BIN)/ninja -C $(ASAN) _native
	LD_PRELOAD="$(ASAN_PRELOAD)" ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
		$(BIN)/python tests/native/sanitized.py $(ASAN) -q -m "not slow" --timeout 250 \
		$(ASAN_TESTS)

SECONDS ?= 20
fuzz: build-full  ## fuzz each reader for SECONDS (20)
	$(BIN)/python -m pip install -q --no-deps --require-hashes -r requirements/fuzz.txt
	PYTHONPATH=. $(BIN)/python tests/fuzz/fuzz.py $(SECONDS) $(TARGETS)

fuzz-nightly:  ## fuzz each reader for ten minutes
	$(MAKE) fuzz SECONDS=600

test-slices: build-full  ## a million macroblocks of the slice coder against FFmpeg; mutated packets
	$(BIN)/python -m pytest tests/codec/test_slice_conformance.py tests/codec/test_mutations.py \
		-m nightly --timeout 1800

test-scale: build-full  ## several servers with Envoy and NATS, each case once
	$(BIN)/python -m pytest tests/integration/test_envoy.py tests/integration/test_nats.py \
		-m nightly --timeout 600

test-aarch64: build-full test-system-packages  ## kernels for AArch64, emulated, give the same bytes
	$(BIN)/python -m pytest tests/native -m nightly --timeout 900

nightly:  ## what .ci/run leaves out (two to three hours)
	.ci/run nightly

##@ Release
lock: $(DEMO)  ## pin versions and hashes in requirements/; UPGRADE=1 takes the newest
	$(BIN)/python -m pip install -q "pip-tools>=7.5"
	PYTHON=$(BIN)/python deploy/lock.sh

wheels:  ## build the wheels for CPython 3.11, and for 3.12 and later, into dist/
	$(PYTHON) deploy/wheels.py build $(PYTHONS)

test-wheels: wheels  ## run the demo by each CPython that is found; compare the bytes it encodes
	$(PYTHON) deploy/wheels.py test $(PYTHONS)

# The stubs are committed, so that installing needs no protoc; tests/wire/test_stubs.py sees drift.
STUBS ?= .
proto: $(FULL)  ## regenerate the gRPC stubs in rfcore/wire/v1
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m grpc_tools.protoc -I proto \
		--python_out=$(STUBS) --grpc_python_out=$(STUBS) --mypy_out=$(STUBS) \
		--mypy_grpc_out=$(STUBS) proto/rfcore/wire/v1/*.proto

##@ Containers
# Wheels are collected here where Python is the image's; else the build does it, which takes longer.
WHEELS_HERE = $(shell $(BIN)/python -c 'import sys; print(sys.version_info[:2] == (3, 11))')
images: build  ## build the images rfedge-runtime and rfedge-full
	@for image in runtime full; do \
		if [ "$(WHEELS_HERE)" = True ]; then \
			PYTHON=$(BIN)/python deploy/wheelhouse.sh $$image build/wheels/$$image; fi && \
		docker build -q --target $$image -t rfedge-$$image:local . || exit 1; done
	@docker image ls --format '{{.Repository}}:{{.Tag}} {{.Size}}' 'rfedge-*'

test-compose: images  ## start docker-compose.yml and look at it (root, docker)
	$(BIN)/python -m pytest -m compose --timeout 1200

# STAND_IN=1: Debian's Prometheus and no Grafana, where no image registry can be reached.
COMPOSE_FILES := -f docker-compose.yml $(if $(STAND_IN),-f deploy/stand-in/docker-compose.yml)
COMPOSE = $(shell docker compose version >/dev/null 2>&1 && echo docker compose || echo docker-compose)
up:  ## start two servers, four vehicles, Prometheus and Grafana
	$(COMPOSE) $(COMPOSE_FILES) up -d
	@. ./.env && echo "dashboards  http://localhost:$$GRAFANA_PORT/dashboards" && \
		echo "Prometheus  http://localhost:$$PROMETHEUS_PORT/targets" && \
		echo "the street  http://localhost:$$TWIN_PORT/?token=$$TWIN_TOKEN"

down:  ## stop them and remove their volumes
	$(COMPOSE) $(COMPOSE_FILES) down -v

include lab/targets.mk

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
	@echo "compiling the kernels (three minutes of two cores the first time)"
	$(BIN)/python -m pip install -q --no-build-isolation --no-deps -e .
	touch $@
