# Everything that lab/results/adapt.json compares, and the file:
#     make -j2 -f lab/adapt/record.mk [DATA=FOLDER] [RESULT=out/adapt/adapt.json]
# Fields and layers are learnt from drives through the sample's street under other circumstances. With DATA, a
# folder that has `street` and `kitti/city` (docs/explanation/evaluation.md), another street at dusk and a real one join.
# What is there is not made again. Some seconds of a core a picture, three minutes a field: an hour on two cores.
OUT    ?= out/adapt
RESULT ?= lab/results/adapt.json
RFEDGE ?= .venv/bin/rfedge
LAB    ?= $(RFEDGE)-lab
STREETGEN ?= $(dir $(RFEDGE))streetgen
DATA   ?=
SAMPLE := samples/fields/street.rff
COMMA  := ,
NOON   := samples/street/transforms_drive_empty.json

.DELETE_ON_ERROR:
.SECONDARY:
.PHONY: record cells
record: cells
	$(LAB) adapt $(EVERY) --cells $(OUT)/cells --out $(RESULT)

# --- drives: SCENE-NUMBER is pass NUMBER of samples/adapt/SCENE.toml

drive = $(OUT)/$1/transforms_drive.json
$(OUT)/%/transforms_drive.json:
	$(STREETGEN) build samples/adapt/$(subst -,.toml:,$*) --split drive --out $(OUT)/$*

# --- fields and layers that were learnt from a drive: base, drive, all or colours

# A layer is looked for beside its base.
$(OUT)/street.rff: $(SAMPLE)
	cp $< $@
define learnt
$(OUT)/$1.rff: $3 $(filter $(OUT)/%,$2) | $(OUT)/street.rff
	$(RFEDGE) field update $2 --from $3 --min-identities 1 --as $4 --out $$@
endef
$(eval $(call learnt,dusk,$(SAMPLE),$(call drive,passes-5),all))
$(eval $(call learnt,dusk-layer,$(SAMPLE),$(call drive,passes-5),colours))
$(eval $(call learnt,dusk-beside,$(SAMPLE),$(call drive,passes-2),all))
$(eval $(call learnt,dusk-beside-layer,$(SAMPLE),$(call drive,passes-2),colours))
$(eval $(call learnt,parked,$(SAMPLE),$(call drive,passes-3),all))
$(eval $(call learnt,noon,$(SAMPLE),$(NOON),all))
$(eval $(call learnt,days-1,$(SAMPLE),$(call drive,days-1),all))
$(eval $(call learnt,days-3,$(SAMPLE),$(call drive,days-3),all))

# --- a drive at the poses that are found in a learnt field, from starts as far off as GNSS is

FOUND := $(OUT)/passes-5/camera.toml
$(OUT)/passes-5/found.tum: $(call drive,passes-5) $(OUT)/dusk-beside.rff
	$(RFEDGE) localise $< --field $(OUT)/dusk-beside.rff --start-error 1.5m:1.5deg --out $@
$(FOUND): $(OUT)/passes-5/found.tum
	printf '%s\n' [camera] 'width_px = 640' 'height_px = 360' 'fx_px = 320.0' [pictures] 'folder = "drive/images"' \
		'rate_hz = 10.0' [trajectory] 'file = "found.tum"' 'outside = "drop"' >$@

# --- cases: NAME@HZ=DRIVE,KEY=PATH... as `rfedge-lab adapt` takes them

STREET := \
	street-dusk@10=$(call drive,passes-5),field=$(SAMPLE),noon=$(NOON),learnt=$(OUT)/dusk-beside.rff,layer=$(OUT)/dusk-beside-layer.rff \
	street-dusk-found@10=$(FOUND),field=$(SAMPLE),noon=$(NOON),learnt=$(OUT)/dusk-beside.rff,layer=$(OUT)/dusk-beside-layer.rff \
	street-dusk-beside@10=$(call drive,passes-2),field=$(SAMPLE),noon=$(call drive,passes-1),learnt=$(OUT)/dusk.rff,layer=$(OUT)/dusk-layer.rff \
	parked@10=$(call drive,passes-4),field=$(SAMPLE),empty=$(call drive,passes-1),learnt=$(OUT)/parked.rff \
	noon-beside@10=$(call drive,passes-1),field=$(SAMPLE),learnt=$(OUT)/noon.rff \
	noon-vehicles@10=samples/street/transforms_drive_vehicles.json,field=$(SAMPLE)
CHANGING := \
	days-1@10=$(call drive,days-1),field=$(SAMPLE) \
	days-2@10=$(call drive,days-2),field=$(SAMPLE),learnt=$(OUT)/days-1.rff \
	days-3@10=$(call drive,days-3),field=$(SAMPLE) \
	days-4@10=$(call drive,days-4),field=$(SAMPLE),learnt=$(OUT)/days-3.rff \
	days-5@10=$(call drive,days-5),field=$(SAMPLE),learnt=$(OUT)/days-1.rff \
	evening@10=$(call drive,changing-1),field=$(SAMPLE),noon=$(NOON),layer=$(OUT)/dusk-beside-layer.rff \
	cloud@10=$(call drive,changing-2),field=$(SAMPLE),noon=$(NOON) \
	tunnel@10=$(call drive,changing-3),field=$(SAMPLE),noon=$(NOON)
GROUPS := STREET CHANGING

ifneq ($(DATA),)
YARD := $(DATA)/street
CITY := $(DATA)/kitti/city
$(OUT)/yardstick.rff: ; $(call train,$(YARD))
$(OUT)/city.rff:      ; $(call train,$(CITY))
train = $(RFEDGE) train $1/transforms_train.json --points $1/points.ply --antialiased --limit 200000 \
	--iterations 3000 --threads 1 --out $@

# Some pictures of a drive, copied beside the others: DRIVE, then START:STOP:STEP.
part = python3 -c "import json, os, shutil; path, out = '$1', '$(@D)'; drive = json.load(open(path)); \
	drive.pop('ply_file_path', None); drive['frames'] = drive['frames'][$2]; names = [f['file_path'] for f in drive['frames']]; \
	[os.makedirs(os.path.dirname(os.path.join(out, name)), exist_ok=True) for name in names]; \
	[shutil.copy(os.path.join(os.path.dirname(path), name), os.path.join(out, name)) for name in names]; \
	json.dump(drive, open('$@', 'w'))"
$(call drive,dusk-even):   $(YARD)/transforms_drive_dusk.json  ; $(call part,$<,0:24:2)
$(call drive,dusk-odd):    $(YARD)/transforms_drive_dusk.json  ; $(call part,$<,1:24:2)
$(call drive,noon-odd):    $(YARD)/transforms_drive_empty.json ; $(call part,$<,1:24:2)
$(call drive,city-first):  $(CITY)/transforms_drive.json       ; $(call part,$<,0:30)
$(call drive,city-second): $(CITY)/transforms_drive.json       ; $(call part,$<,30:60)
$(eval $(call learnt,yardstick-dusk,$(OUT)/yardstick.rff,$(call drive,dusk-even),all))
$(eval $(call learnt,yardstick-dusk-layer,$(OUT)/yardstick.rff,$(call drive,dusk-even),colours))
# Learning that saves nothing writes nothing and says why; then there is no such variant.
$(OUT)/city-first.txt: $(call drive,city-first) $(OUT)/city.rff
	$(RFEDGE) field update $(OUT)/city.rff --from $< --min-identities 1 --out $(OUT)/city-first.rff >$@.part 2>&1 || \
		grep -q 'nothing is written' $@.part
	mv $@.part $@

YARDSTICK := \
	dusk@10=$(YARD)/transforms_drive_dusk.json,field=$(OUT)/yardstick.rff,noon=$(YARD)/transforms_drive_empty.json \
	odd-dusk@5=$(call drive,dusk-odd),field=$(OUT)/yardstick.rff,noon=$(call drive,noon-odd),learnt=$(OUT)/yardstick-dusk.rff,layer=$(OUT)/yardstick-dusk-layer.rff \
	noon-yardstick-vehicles@10=$(YARD)/transforms_drive_vehicles.json,field=$(OUT)/yardstick.rff \
	noon-yardstick-vehicles@30=$(YARD)/transforms_drive30_vehicles.json,field=$(OUT)/yardstick.rff
REAL = city-second-half@5=$(call drive,city-second),field=$(OUT)/city.rff$(if $(wildcard $(OUT)/city-first.rff),$(COMMA)learnt=$(OUT)/city-first.rff)
$(OUT)/REAL.json: $(OUT)/city-first.txt
GROUPS += YARDSTICK REAL
endif

# Groups of cases are coded side by side; the file is then made of their cells.
EVERY = $(foreach group,$(GROUPS),$($(group)))
made  = $(filter $(OUT)/%,$(subst $(COMMA), ,$(subst =, ,$($1))))
define coded
$(OUT)/$1.json: $(call made,$1)
	$(LAB) adapt $$($1) --cells $(OUT)/cells --out $$@
endef
$(foreach group,$(GROUPS),$(eval $(call coded,$(group))))
cells: $(GROUPS:%=$(OUT)/%.json)
