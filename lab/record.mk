# Results of `rfedge eval` and `rfedge-lab` for lab/results, made on a quiet machine from a committed revision:
#     make results [DATA=FOLDER]         what takes two hours of two cores
#     make results-full [DATA=FOLDER]    the rest, too, which takes days
# DATA is a folder that has `street` (the yardstick), `kitti/city` and `kitti/loop` (docs/how-to/compare.md); without it the
# sample's drives are compared alone. A record that is in out/results is not made
# again: delete its file there. Faults and attacks have targets in the Makefile, loads in lab/targets.mk.
OUT    ?= out/results
RFEDGE ?= .venv/bin/rfedge
LAB    ?= $(RFEDGE)-lab
STREETGEN ?= $(dir $(RFEDGE))streetgen
DATA   ?=
SAMPLE := samples/fields/street.rff
EMPTY    := samples/street/transforms_drive_empty.json
VEHICLES := samples/street/transforms_drive_vehicles.json

.DELETE_ON_ERROR:
.SECONDARY:
.PHONY: results results-full
results: $(patsubst %,$(OUT)/%.json,bench-raster bench-train bench-codec classes never-worse lossy-link robust ladder latency head compare compare-small)
	cp $^ lab/results/
results-full: results $(patsubst %,$(OUT)/%.json,bench-ngp bench-gpu compare-harder compare-noise compare-size robust-long localise benchmark $(if $(DATA),detect) rig live live-truth cold-start world paper)
	cp $(filter %.json,$^) lab/results/
	$(MAKE) -f lab/adapt/record.mk DATA=$(DATA) RFEDGE=$(RFEDGE)

$(OUT):
	mkdir -p $@

# --- fields that do not ship, trained by iterations: the same bytes on every machine, in minutes that differ

# Of so many thousand splats, which few passes of a street pay for. A sky would take too many of them (docs/how-to/training.md).
small = $(RFEDGE) train $1 --points $(dir $1)points.ply --held-out $2 --gaussians $$(($*000 * 3 / 4)) --limit $*000 --sh-degree 1 --antialiased \
	--max-mb 1 --iterations 4000 --out $@
$(OUT)/sample-%k.rff: | $(OUT)
	$(call small,samples/street/transforms_train.json,$(EMPTY))
NGP := $(OUT)/street-ngp.rff
$(NGP): | $(OUT)
	$(RFEDGE) train samples/street/transforms_train.json --points samples/street/points.ply --held-out $(EMPTY) --kind ngp --iterations 8000 --out $@
ifneq ($(DATA),)
YARD := $(DATA)/street
LOOP := $(DATA)/kitti/loop
CITY := $(DATA)/kitti/city
trained = $(RFEDGE) train $1 --points $(dir $1)points.ply --held-out $2 --antialiased --limit $3 --iterations $4 --out $@
$(OUT)/yardstick.rff: | $(OUT)
	$(call trained,$(YARD)/transforms_train.json,$(YARD)/transforms_drive_empty.json,250000,6000)
$(OUT)/city.rff: | $(OUT)
	$(call trained,$(CITY)/transforms_train.json,$(CITY)/transforms_drive.json,250000,5000)
$(OUT)/loop.rff: | $(OUT)
	$(call trained,$(LOOP)/transforms_first.json,$(LOOP)/transforms_second.json,400000,20000)
$(OUT)/yardstick-%k.rff: | $(OUT)
	$(call small,$(YARD)/transforms_train.json,$(YARD)/transforms_drive_empty.json)
FIELDS := $(patsubst %,$(OUT)/%.rff,yardstick city loop)
# The second pass at poses that are found in the field of the first, the first of them without any start.
LOOP_LENS = $$($(dir $(RFEDGE))python -c "import json; t = json.load(open('$(LOOP)/transforms_second.json')); print(*(t[k] for k in ('fl_x', 'fl_y', 'cx', 'cy')))")
$(OUT)/loop-localised/transforms.json: $(OUT)/loop.rff
	mkdir -p $(OUT)/loop-second && cp $(LOOP)/images/second_* $(OUT)/loop-second
	$(RFEDGE) dataset poses $(OUT)/loop-second --register-to $< --camera-model PINHOLE --parameters $(LOOP_LENS) --up=-y --out $(@D)
LOCALISED := kitti-loop-localised@10=$(OUT)/loop-localised/transforms.json,$(OUT)/loop.rff
# One more drive of a single pass, of pictures alone: COLMAP poses every second one, then the others among them.
RESIDENTIAL := $(OUT)/residential
PINHOLE = --camera-model PINHOLE --parameters $$(awk '/^P2:/ {print $$2, $$7, $$4, $$8}' $(DATA)/kitti/residential/calib.txt)
$(RESIDENTIAL)/map/transforms.json: | $(OUT)
	mkdir -p $(RESIDENTIAL)/even $(RESIDENTIAL)/odd
	cp $(DATA)/kitti/residential/image_2/*[02468].png $(RESIDENTIAL)/even
	cp $(DATA)/kitti/residential/image_2/*[13579].png $(RESIDENTIAL)/odd
	$(RFEDGE) dataset poses $(RESIDENTIAL)/even $(PINHOLE) --out $(@D)
$(OUT)/residential.rff: $(RESIDENTIAL)/map/transforms.json
	$(RFEDGE) train $< --points $(<D)/points.ply --antialiased --limit 250000 --iterations 5000 --out $@
$(RESIDENTIAL)/drive/transforms.json: $(RESIDENTIAL)/map/transforms.json
	$(RFEDGE) dataset poses $(RESIDENTIAL)/odd --register-to $(<D) --out $(@D)
RESIDENTIAL_DRIVE := kitti-residential@5=$(RESIDENTIAL)/drive/transforms.json,$(OUT)/residential.rff
endif

# --- drives: through the sample's street under other circumstances, and of other people

SCENES := $(OUT)/scenes
drive = $(SCENES)/$1/transforms_drive.json
COMMA := ,
effects = (cat samples/street/empty.toml; echo; awk -v RS= -v ORS='\n\n' '/^\[effects$2/' streetgen/scenes/$1.toml) >$@
lane = (cat samples/street/empty.toml; echo 'lane_offset_m = $1') >$@

$(SCENES):
	mkdir -p $@
$(SCENES)/lane-%.toml: samples/street/empty.toml | $(SCENES)
	$(call lane,$*)
$(SCENES)/dusk.toml: samples/street/empty.toml | $(SCENES)
	$(call effects,street-dusk)
$(SCENES)/rain.toml: samples/street/empty.toml | $(SCENES)
	$(call effects,street-rain)
$(SCENES)/rolling-shutter.toml: samples/street/empty.toml | $(SCENES)
	$(call effects,street-sensor,.rolling_shutter)
$(SCENES)/exposure.toml: samples/street/empty.toml | $(SCENES)
	$(call effects,street-sensor,.exposure)
$(SCENES)/lens.toml: samples/street/empty.toml | $(SCENES)
	$(call effects,street-sensor,.lens)
$(SCENES)/people.toml: samples/street/people.toml | $(SCENES)
	cp $< $@
# At other rates and sizes, and no longer than latencies need.
$(SCENES)/20hz.toml: samples/street/vehicles.toml | $(SCENES)
	sed 's/^rate_hz.*/rate_hz = 20.0/; s/^duration_s.*/duration_s = 1.2/' $< >$@
$(SCENES)/vehicles-30hz.toml: samples/street/vehicles.toml | $(SCENES)
	sed 's/^rate_hz.*/rate_hz = 30.0/; s/^duration_s.*/duration_s = 0.8/' $< >$@
$(SCENES)/vehicles-720p.toml: samples/street/vehicles.toml | $(SCENES)
	sed 's/^size_px.*/size_px = [1280, 720]/; s/^duration_s.*/duration_s = 1.2/' $< >$@
$(SCENES)/vehicles-720p-30hz.toml: $(SCENES)/vehicles-30hz.toml
	sed 's/^size_px.*/size_px = [1280, 720]/; s/^duration_s.*/duration_s = 0.4/' $< >$@
$(SCENES)/vehicles-%/transforms_drive.json: $(SCENES)/vehicles-%.toml
	$(STREETGEN) build $< --split drive --spp 9 --out $(@D)
$(SCENES)/%/transforms_drive.json: $(SCENES)/%.toml
	$(STREETGEN) build $< --split drive --out $(@D)

# Through a lens, as a vehicle codes it.
UNDISTORTED := $(SCENES)/undistorted/transforms.json
$(UNDISTORTED): $(call drive,lens)
	$(RFEDGE) dataset convert $< --out $(@D)

HARDER := lane-0.6 lane-1.5 dusk rain rolling-shutter exposure people
HARDER_DRIVES := $(foreach name,$(HARDER) 20hz,$(call drive,$(name))) $(UNDISTORTED)

NOON := sample-empty@10=$(EMPTY) sample-vehicles@10=$(VEHICLES)
REAL := $(if $(DATA),kitti-loop@10=$(LOOP)/transforms_second.json$(COMMA)$(OUT)/loop.rff \
	kitti-city@5=$(CITY)/transforms_drive.json$(COMMA)$(OUT)/city.rff)
YARDSTICK := $(if $(DATA),yardstick-empty@10=$(YARD)/transforms_drive_empty.json$(COMMA)$(OUT)/yardstick.rff \
	yardstick-vehicles@10=$(YARD)/transforms_drive_vehicles.json$(COMMA)$(OUT)/yardstick.rff)
YARDSTICK_30 := $(if $(DATA),yardstick-empty@30=$(YARD)/transforms_drive30_empty.json$(COMMA)$(OUT)/yardstick.rff \
	yardstick-vehicles@30=$(YARD)/transforms_drive30_vehicles.json$(COMMA)$(OUT)/yardstick.rff)
NOISY := sample-vehicles@10=$(VEHICLES)$(COMMA)noise=1.5 sample-vehicles@10=$(VEHICLES)$(COMMA)noise=3 \
	$(if $(DATA),yardstick-vehicles@10=$(YARD)/transforms_drive_vehicles.json$(COMMA)$(OUT)/yardstick.rff$(COMMA)noise=3)

# --- the sample's street at sizes that cameras have: views to train on, the two drives, and a field of each size
# `make -f lab/record.mk sizes` renders them, 1280x720 in 35 minutes of two cores and 1920x1080 in 80; streetgen says how
# long before it starts, and goes on where it was stopped.

SIZE := $(OUT)/size
SIZES := 1280x720 1920x1080
.PHONY: sizes
sizes: $(foreach size,$(SIZES),$(SIZE)/$(size)/train/transforms_train.json \
	$(foreach of,empty vehicles,$(SIZE)/$(size)/$(of)/transforms_drive.json))
$(SIZE)/%/train/transforms_train.json:
	$(STREETGEN) build samples/street/empty.toml --split train --size $* --spp 4 --out $(@D)
$(SIZE)/%/empty/transforms_drive.json:
	$(STREETGEN) build samples/street/empty.toml --split drive --size $* --spp 9 --out $(@D)
$(SIZE)/%/vehicles/transforms_drive.json:
	$(STREETGEN) build samples/street/vehicles.toml --split drive --size $* --spp 9 --out $(@D)
$(SIZE)/1280x720.rff: LIMITS = --limit 600000 --iterations 10000 --max-mb 8
$(SIZE)/1920x1080.rff: LIMITS = --limit 1200000 --iterations 12000 --max-mb 12
$(SIZE)/%.rff: $(SIZE)/%/train/transforms_train.json $(SIZE)/%/empty/transforms_drive.json
	$(RFEDGE) train $< --points samples/street/points.ply --held-out $(word 2,$^) --antialiased --sh-degree 1 --sky 60000 \
		$(LIMITS) --json $(@:.rff=.json) --out $@
sized = sample-$1-$2@10=$(SIZE)/$2/$1/transforms_drive.json$(COMMA)$(SIZE)/$3.rff
OF_SIZES := $(foreach size,$(SIZES),$(foreach of,empty vehicles,$(call sized,$(of),$(size),$(size))))
# The largest one's field at smaller sizes, too.
LARGEST := $(lastword $(SIZES))
OF_ONE := $(foreach of,empty vehicles,sample-$(of)@10=samples/street/transforms_drive_$(of).json$(COMMA)$(SIZE)/$(LARGEST).rff \
	$(foreach size,$(filter-out $(LARGEST),$(SIZES)),$(call sized,$(of),$(size),$(LARGEST))))

# --- records

$(OUT)/bench-%.json: | $(OUT)
	$(LAB) bench $* --json $@
$(OUT)/bench-gpu.json: | $(OUT)  # on PoCL where there is no other OpenCL
	$(LAB) bench raster --rows native --isa opencl --json $@
# What a machine with a GPU carries, with and without it: a server's vehicles, and both ends of one vehicle. Sixteen
# workers' memory takes half a minute to settle.
LOADTEST = $(RFEDGE) loadtest --record $@ --duration 15 --warm-up 30 --workers $(shell nproc)
$(OUT)/load-gpu.json: $(call drive,vehicles-720p) | $(OUT)
	for renderer in opencl cpu; do \
		$(LOADTEST) --renderer $$renderer --vehicles 12 --find-limit --out $(OUT)/load-gpu/limit-$$renderer || exit; \
	done
	for hz in 10 30; do for renderer in opencl cpu; do \
		$(LOADTEST) --renderer $$renderer --threads 4 --vehicles 1 --live --drive $< --hz $$hz --out $(OUT)/load-gpu/live-$$renderer || true; \
	done; done
$(OUT)/compare.json: $(FIELDS) $(if $(DATA),$(OUT)/loop-localised/transforms.json) | $(OUT)
	$(RFEDGE) eval compare $(SAMPLE) $(NOON) $(REAL) $(LOCALISED) $(YARDSTICK) --background sample-vehicles@10=$(EMPTY) \
		$(if $(DATA),yardstick-vehicles@10=$(YARD)/transforms_drive_empty.json) \
		--processes $(shell nproc) --cells $(OUT)/compare --out $@
$(OUT)/compare-harder.json: $(HARDER_DRIVES) | $(OUT)
	$(RFEDGE) eval compare $(SAMPLE) $(foreach name,$(HARDER),sample-$(name)@10=$(call drive,$(name))) \
		sample-lens@10=$(UNDISTORTED) sample-vehicles@20=$(call drive,20hz) --background sample-people@10=$(EMPTY) \
		--processes $(shell nproc) --cells $(OUT)/compare --out $@
# Noise, 30 Hz, and a third real street.
$(OUT)/compare-noise.json: $(FIELDS) $(if $(DATA),$(RESIDENTIAL)/drive/transforms.json $(OUT)/residential.rff) | $(OUT)
	$(RFEDGE) eval compare $(SAMPLE) $(NOISY) $(YARDSTICK_30) $(RESIDENTIAL_DRIVE) \
		--processes $(shell nproc) --cells $(OUT)/compare --out $@
$(OUT)/compare-size.json: $(foreach size,$(SIZES),$(SIZE)/$(size).rff $(SIZE)/$(size)/vehicles/transforms_drive.json) | $(OUT)
	$(RFEDGE) eval compare $(SAMPLE) $(OF_SIZES) $(OF_ONE) --rivals x264-our-tools-medium svtav1-lowdelay-p4 \
		--method lab.libaom:Good3 lab.libaom:Good6 --processes $(shell nproc) --cells $(OUT)/compare --out $@
$(OUT)/compare-small.json: $(foreach k,30 60,$(OUT)/sample-$(k)k.rff $(if $(DATA),$(OUT)/yardstick-$(k)k.rff)) | $(OUT)
	$(RFEDGE) eval compare $(SAMPLE) --rivals x264-our-tools-medium --processes $(shell nproc) --cells $(OUT)/compare --out $@ \
		$(foreach k,30 60,$(foreach drive,$(NOON),$(drive)$(COMMA)$(OUT)/sample-$(k)k.rff) \
			$(if $(DATA),$(foreach of,empty vehicles,yardstick-$(of)@30=$(YARD)/transforms_drive30_$(of).json$(COMMA)$(OUT)/yardstick-$(k)k.rff)))
$(OUT)/classes.json: $(call drive,people) | $(OUT)
	$(LAB) classes $(SAMPLE) people@10=$< --cells $(OUT)/classes --out $@
# Of a detector that does not ship: FastestDet.onnx of dog-qiuqiu/FastestDet, in DATA/weights.
$(OUT)/detect.json: $(call drive,people) $(if $(DATA),$(RESIDENTIAL)/drive/transforms.json $(OUT)/residential.rff $(OUT)/loop.rff $(OUT)/city.rff) | $(OUT)
	$(LAB) detect $(SAMPLE) people@10=$< sample-vehicles@10=$(VEHICLES) $(REAL) $(RESIDENTIAL_DRIVE) \
		--detector $(DATA)/weights/FastestDet.onnx --cells $(OUT)/detect --out $@
$(OUT)/never-worse.json: | $(OUT)
	$(RFEDGE) eval never-worse $(SAMPLE) $(NOON) --decimated $(NOON) --cells $(OUT)/never-worse --out $@
$(OUT)/lossy-link.json: | $(OUT)
	$(RFEDGE) eval lossy-link --rates-mbps 0.5 2 8 --losses 0 1 2 5 --seeds 5 --cells $(OUT)/lossy-link --out $@
# With GStreamer and gpsd (`make test-system-packages`), and beside the revision before its faults were ended.
$(OUT)/live-truth.json: | $(OUT)
	$(LAB) live-truth --before 5e03a6d4 $(if $(DATA),--comma $(DATA)/comma2k19) --out $@
$(OUT)/tcp.json: | $(OUT)  # as root: network namespaces
	$(LAB) tcp --out $@
$(OUT)/webrtc.json: | $(OUT)  # as root, on two idle cores; peers: pip install aiortc wrtc
	$(LAB) webrtc --cells $(OUT)/webrtc --out $@
# Ten pictures a second do not tell apart round trips that are shorter than 100 ms.
$(OUT)/robust.json: $(call drive,dusk) $(call drive,lane-0.6) | $(OUT)
	$(LAB) robust --dusk dusk@10=$< --lane lane-0.6@10=$(word 2,$^) --rtts-ms 50 250 --seeds 20 --processes $(shell nproc) \
		--cells $(OUT)/robust --out $@
# Loss with a hundred seeds, over half a minute of the street: 300 frames, small, for it is hours of a core.
LONG := $(SCENES)/long/transforms_drive.json
$(LONG): samples/localise/drive_30s.toml | $(SCENES)
	$(STREETGEN) build $< --split drive --size 320x180 --spp 9 --out $(@D)
$(OUT)/robust-long.json: $(LONG) | $(OUT)
	$(LAB) robust $(SAMPLE) long@10=$< --frames 300 --seeds 100 --rtts-ms 50 --processes $(shell nproc) --cells $(OUT)/robust --out $@
$(OUT)/ladder.json: $(NGP) | $(OUT)
	$(RFEDGE) eval ladder $(SAMPLE) $(NGP) --frames 8 --cells $(OUT)/ladder --out $@
FASTER := vehicles-30hz vehicles-720p vehicles-720p-30hz
$(OUT)/latency.json: $(foreach name,$(FASTER),$(call drive,$(name))) | $(OUT)
	$(LAB) latency $(SAMPLE) $(subst sample-,,$(NOON)) vehicles@30=$(call drive,vehicles-30hz) \
		vehicles-720p@10=$(call drive,vehicles-720p) vehicles-720p@30=$(call drive,vehicles-720p-30hz) --cells $(OUT)/latency --out $@
# Every kind of start and error in the empty street, here and on drives of others; elsewhere the usual start alone.
ROWS := $(COMMA)rows=2m:3deg
PLACES := sample=$(EMPTY),$(SAMPLE) $(if $(DATA),\
	yardstick=$(YARD)/transforms_drive30_empty.json$(COMMA)$(OUT)/yardstick.rff$(COMMA)hz=30$(COMMA)frames=72 \
	city=$(CITY)/transforms_drive.json$(COMMA)$(OUT)/city.rff$(COMMA)hz=5$(COMMA)frames=60$(COMMA)units=0.17 \
	loop=$(LOOP)/transforms_second.json$(COMMA)$(OUT)/loop.rff$(COMMA)feed=$(LOOP)/official_second.txt$(COMMA)feed_map=$(LOOP)/official_first.txt$(COMMA)map=$(LOOP)/transforms_first.json)
STRANGERS := $(if $(DATA),--strangers $(DATA)/fox/transforms.json $(DATA)/kitti/residential)
$(OUT)/localise.json: $(call drive,dusk) $(call drive,lane-1.5) $(FIELDS) | $(OUT)
	$(LAB) localise $(PLACES) vehicles=$(VEHICLES),$(SAMPLE)$(ROWS) noise=$(EMPTY),$(SAMPLE),noise=3$(ROWS) \
		dusk=$(call drive,dusk),$(SAMPLE)$(ROWS) lane=$(call drive,lane-1.5),$(SAMPLE)$(ROWS) \
		--tries 100 --false-starts 50 --seed 2 $(STRANGERS) --cells $(OUT)/localise --out $@
$(OUT)/rig.json: $(OUT)/rig/rig.toml $(OUT)/rig18/rig.toml
	$(LAB) rig --rig $(OUT)/rig --many $(OUT)/rig18 --link-bps 300000 --rate-hz 2 --max-delay-ms 2500 --work $(OUT)/rig-work --out $@
$(OUT)/rig/rig.toml: | $(OUT)
	$(STREETGEN) build samples/street/vehicles.toml --split rig --spp 9 --out $(@D)
$(OUT)/rig18/rig.toml: | $(OUT)
	$(STREETGEN) build samples/street/vehicles.toml --split rig --rig all --size 300x168 --spp 9 --frames 0:72 --out $(@D)
$(OUT)/live.json: | $(OUT)
	$(LAB) live --cameras 1 4 8 --hz 1 --rounds 2 --work $(OUT)/live --out $@
$(OUT)/cold-start.json: | $(OUT)
	$(LAB) cold-start --work $(OUT)/cold-start --out $@
$(OUT)/world.json: | $(OUT)
	$(LAB) world --work $(OUT)/world --out $@
# Heads of frames cost the same whatever the field and the quality: the sample's field serves every drive.
$(OUT)/head/sample-vehicles.rfv: DRIVE = $(VEHICLES)
$(OUT)/head/yardstick-empty.rfv: DRIVE = $(YARD)/transforms_drive_empty.json
$(OUT)/head/yardstick-empty-30hz.rfv: DRIVE = $(YARD)/transforms_drive30_empty.json
$(OUT)/head/kitti-loop.rfv: DRIVE = $(LOOP)/transforms_second.json
$(OUT)/head/kitti-city.rfv: DRIVE = $(CITY)/transforms_drive.json
$(OUT)/head/%.rfv: DRIVE = $(EMPTY)
$(OUT)/head/%.rfv: | $(OUT)
	mkdir -p $(@D)
	$(RFEDGE) encode $(DRIVE) --field $(SAMPLE) --crf 35 --effort fast $(if $(findstring found,$*),--localise) --out $@
$(OUT)/head.json: $(patsubst %,$(OUT)/head/%.rfv,sample-empty sample-empty-found sample-vehicles \
		$(if $(DATA),yardstick-empty yardstick-empty-30hz kitti-loop kitti-city))
	$(LAB) head $^ --before lab/head_before.json --json $@
BENCH := $(dir $(RFEDGE))python examples/bench_rfedge.py
$(OUT)/benchmark:
	$(LAB) benchmark run $@ --name rfedge --points 17 20 23 26 29 32 35 38 41 --prior $(SAMPLE) \
		--method "$(BENCH) encode {prior}/street.rff {frames} {out} {point}"
$(OUT)/benchmark.json: $(OUT)/benchmark
	$(LAB) benchmark check $< --decoder "$(BENCH) decode {prior}/street.rff {packets} {out}" --out $@

# --- the published experiment whole: 144 poses, two scenes, two fields of that very street
# Nine samples a pixel and the denoiser: 13 to 40 s a picture of two cores, 1.1 to 3.3 hours for 288, and minutes with
# CUDA and sixteen cores. Trained on as many views as cover the street as densely as a car's cameras do; the recorded
# hash grid on larger ones, for 9.1 minutes of eight cores.

PAPER := $(OUT)/paper-street
$(PAPER)/street-empty.toml: streetgen/scenes/street-empty.toml
	mkdir -p $(@D) && sed 's/^views.*/views = 720/' $< >$@
$(PAPER)/train-%/transforms_train.json: $(PAPER)/street-empty.toml
	$(STREETGEN) build $< --split train --size $* --spp 9 --out $(@D)
$(PAPER)/%/transforms_eval.json:
	$(STREETGEN) build street-$* --split eval --size 1920x1080 --spp 9 --out $(@D)
$(PAPER)/3dgs.rff: $(PAPER)/train-640x360/transforms_train.json
	$(RFEDGE) train $< --antialiased --limit 600000 --sky 60000 --iterations 15000 --json $(@:.rff=.json) --out $@
$(PAPER)/ingp.rff: $(PAPER)/train-800x450/transforms_train.json
	$(RFEDGE) train $< --kind ngp --iterations 30000 --json $(@:.rff=.json) --out $@
# Weights: `make lpips-weights`. Without them the columns of LPIPS are left out.
LPIPS := $(if $(wildcard out/lpips/alexnet.ckpt),--lpips-weights out/lpips)
$(OUT)/paper.json: $(PAPER)/3dgs.rff $(PAPER)/ingp.rff $(PAPER)/empty/transforms_eval.json $(PAPER)/parked/transforms_eval.json
	$(LAB) paper --fields 3dgs=$(PAPER)/3dgs.rff ingp=$(PAPER)/ingp.rff --sizes 300x168 500x280 720x404 1920x1080 \
		--drives empty=$(PAPER)/empty/transforms_eval.json parked=$(PAPER)/parked/transforms_eval.json \
		--processes $(shell nproc) --cells $(OUT)/paper $(LPIPS) --out $@
