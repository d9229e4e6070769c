#!/bin/sh
# Fills a folder with all the wheels of an image: deploy/wheelhouse.sh runtime|full FOLDER
# PYTHON (3.11, as in the image) and PIP may be set. The samples stay outside.
# Runs on the host for `make images`, and in the build itself where the host prepared nothing.
set -eu
image=$1
folder=$2
: "${PYTHON:=python3}"
: "${PIP:=$PYTHON -m pip}"

rm -rf "$folder.part"
mkdir -p "$folder.part/pip"
$PIP download -q --no-deps --only-binary=:all: -d "$folder.part/pip" "pip>=25.1"
$PIP wheel -q --no-build-isolation --no-deps -C cmake.define.RFEDGE_SAMPLES=OFF -w "$folder.part" .
$PIP download -q --no-deps --only-binary=:all: --require-hashes -d "$folder.part" -r "requirements/$image.txt"
rm -rf "$folder"
mv "$folder.part" "$folder"
