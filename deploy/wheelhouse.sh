#!/bin/sh
# Fills a folder with all the wheels of an image: deploy/wheelhouse.sh runtime|full FOLDER
# PYTHON (3.11, as in the image) and PIP may be set; TORCH_INDEX is an index of CPU builds of PyTorch.
# Runs on the host for `make images`, and in the build itself where the host prepared nothing.
set -eu
image=$1
folder=$2
: "${PYTHON:=python3}"
: "${PIP:=$PYTHON -m pip}"

rm -rf "$folder.part"
mkdir -p "$folder.part/pip"
"$PYTHON" deploy/requirements.py "$image" > "$folder.part/requirements.txt"
$PIP download -q --no-deps --only-binary=:all: -d "$folder.part/pip" "pip>=25.1"
$PIP wheel -q --no-build-isolation --no-deps -w "$folder.part" .
$PIP download -q --only-binary=:all: ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} \
	-d "$folder.part" -r "$folder.part/requirements.txt"
if ls "$folder.part" | grep -q '^nvidia_'; then
	echo "the package index brought a CUDA build of PyTorch; set TORCH_INDEX to one of CPU builds" >&2
	exit 2
fi
rm -rf "$folder"
mv "$folder.part" "$folder"
