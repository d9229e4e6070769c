#!/bin/sh
# Collects and compiles the wheels inside the build, which needs a package index: runtime|full
set -eu
apt-get update
apt-get install -y --no-install-recommends g++ python3-dev python3-venv
python3 -m venv /build
/build/bin/pip install -q --no-deps --require-hashes -r requirements/demo.txt
PYTHON=/build/bin/python PATH="/build/bin:$PATH" deploy/wheelhouse.sh "$1" "build/wheels/$1"
