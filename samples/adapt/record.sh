#!/bin/sh
# Makes everything that results/adapt.json compares, and the file: sample street under other circumstances,
# fields and layers learnt from passes through it; with DATA, a folder that has `street` and `kitti/city`
# (docs/evaluation.md), a second street at dusk and a real one. What is there is not made again.
# Some seconds of two cores a picture, two to four minutes a field: hours in all, on a slow machine.
set -eu
OUT=${OUT:-out/adapt}
RFEDGE=${RFEDGE:-.venv/bin/rfedge}
SAMPLE=samples/fields/street.rff
NOON=samples/street/transforms_drive_empty.json
VEHICLES=samples/street/transforms_drive_vehicles.json
mkdir -p "$OUT"

drive() { echo "$OUT/$1/transforms_drive.json"; }
built() { # SCENE NUMBER
    [ -e "$(drive "$1-$2")" ] || $RFEDGE scene build "samples/adapt/$1.toml:$2" --split drive --out "$OUT/$1-$2"
}
learnt() { # NAME FIELD AS VEHICLES DRIVE...
    name=$1 field=$2 as=$3 vehicles=$4
    shift 4
    [ -e "$OUT/$name.rff" ] || $RFEDGE field update "$field" --from "$@" --min-identities "$vehicles" --as "$as" --out "$OUT/$name.rff"
}

for n in 1 2 3 4 5; do built passes $n; done
for n in 1 2 3 4 5; do built days $n; done
for n in 1 2 3; do built changing $n; done

learnt dusk street all 1 "$(drive passes-5)"
learnt dusk-layer street colours 1 "$(drive passes-5)"
learnt dusk-beside street all 1 "$(drive passes-2)"
learnt dusk-beside-layer street colours 1 "$(drive passes-2)"
learnt parked street all 1 "$(drive passes-3)"
learnt noon street all 1 "$NOON"
learnt days-1 street all 1 "$(drive days-1)"
learnt days-3 street all 1 "$(drive days-3)"

HERE="field=$SAMPLE,noon=$NOON"
BESIDE=$(drive passes-1)
set -- \
    "street-dusk@10=$(drive passes-5),$HERE,learnt=$OUT/dusk-beside.rff,layer=$OUT/dusk-beside-layer.rff" \
    "street-dusk-beside@10=$(drive passes-2),field=$SAMPLE,noon=$BESIDE,learnt=$OUT/dusk.rff,layer=$OUT/dusk-layer.rff" \
    "parked@10=$(drive passes-4),field=$SAMPLE,empty=$BESIDE,learnt=$OUT/parked.rff" \
    "noon-beside@10=$BESIDE,field=$SAMPLE,learnt=$OUT/noon.rff" \
    "noon-vehicles@10=$VEHICLES,field=$SAMPLE" \
    "days-1@10=$(drive days-1),field=$SAMPLE" \
    "days-2@10=$(drive days-2),field=$SAMPLE,learnt=$OUT/days-1.rff" \
    "days-3@10=$(drive days-3),field=$SAMPLE" \
    "days-4@10=$(drive days-4),field=$SAMPLE,learnt=$OUT/days-3.rff" \
    "days-5@10=$(drive days-5),field=$SAMPLE,learnt=$OUT/days-1.rff" \
    "evening@10=$(drive changing-1),$HERE,layer=$OUT/dusk-beside-layer.rff" \
    "cloud@10=$(drive changing-2),$HERE" \
    "tunnel@10=$(drive changing-3),$HERE"

part() { # FILE START STOP STEP: some pictures of a drive, as a drive in $OUT
    python3 - "$1" "$OUT" "$2" "$3" "$4" <<'PYTHON'
import json, os, sys
path, out = sys.argv[1:3]
start, stop, step = (int(number) for number in sys.argv[3:])
drive = json.load(open(path))
drive["frames"] = drive["frames"][start:stop:step]
drive.pop("ply_file_path", None)
for frame in drive["frames"]:
    frame["file_path"] = os.path.relpath(os.path.join(os.path.dirname(path), frame["file_path"]), out)
name = os.path.basename(path).removesuffix(".json")
name = f"{name}_{start}_{step}.json"
json.dump(drive, open(os.path.join(out, name), "w"))
print(os.path.join(out, name))
PYTHON
}

if [ "${DATA:-}" ]; then
    YARD=$DATA/street CITY=$DATA/kitti/city
    trained() { # NAME FOLDER
        [ -e "$OUT/$1.rff" ] || $RFEDGE train "$2/transforms_train.json" --points "$2/points.ply" --antialiased \
            --limit 250000 --iterations 5000 --threads "${THREADS:-2}" --out "$OUT/$1.rff"
    }
    trained yardstick "$YARD"
    trained city "$CITY"
    DUSK=$YARD/transforms_drive_dusk.json
    EVEN=$(part "$DUSK" 0 24 2) ODD=$(part "$DUSK" 1 24 2) ODD_NOON=$(part "$YARD/transforms_drive_empty.json" 1 24 2)
    FIRST=$(part "$CITY/transforms_drive.json" 0 30 1) SECOND=$(part "$CITY/transforms_drive.json" 30 60 1)
    learnt yardstick-dusk "$OUT/yardstick.rff" all 1 "$EVEN"
    learnt yardstick-dusk-layer "$OUT/yardstick.rff" colours 1 "$EVEN"
    set -- "$@" \
        "dusk@10=$DUSK,field=$OUT/yardstick.rff,noon=$YARD/transforms_drive_empty.json" \
        "odd-dusk@5=$ODD,field=$OUT/yardstick.rff,noon=$ODD_NOON,learnt=$OUT/yardstick-dusk.rff,layer=$OUT/yardstick-dusk-layer.rff" \
        "noon-yardstick-vehicles@10=$YARD/transforms_drive_vehicles.json,field=$OUT/yardstick.rff" \
        "noon-yardstick-vehicles@30=$YARD/transforms_drive30_vehicles.json,field=$OUT/yardstick.rff"
    # Learning that saves nothing writes nothing, and says so.
    if learnt city-first "$OUT/city.rff" all 1 "$FIRST"; then
        set -- "$@" "kitti-city-second-half@5=$SECOND,field=$OUT/city.rff,learnt=$OUT/city-first.rff"
    else
        set -- "$@" "kitti-city-second-half@5=$SECOND,field=$OUT/city.rff"
    fi
fi

$RFEDGE eval adapt "$@" --cells "$OUT/cells" --out "${RESULT:-results/adapt.json}"
