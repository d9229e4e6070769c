#!/bin/sh
# Pins what each set of deploy/requirements.py installs, with hashes, in requirements/*.txt.
# PYTHON must be a 3.11 with the dependency group `lock`. Sets agree on versions: each is compiled
# under the pins of `test`, which has them all. No file names an index. torch is pinned without a
# hash, in requirements/torch.txt: every index has a build of its own under the same version.
set -eu
: "${PYTHON:=python3}"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p requirements
for name in test demo runtime full; do
	"$PYTHON" deploy/requirements.py $name > "$work/$name.in"
	"$PYTHON" -m piptools compile -q --upgrade --generate-hashes --unsafe-package torch --strip-extras \
		--no-header --no-annotate --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
		--no-emit-options ${under:+-c "$under"} -o "$work/$name.txt" "$work/$name.in"
	grep -v '^#' "$work/$name.txt" | grep . > "requirements/$name.txt"
	sed 's/ *\\$//; /^ *--hash/d' "requirements/$name.txt" > "$work/$name.pins"
	under="$work/test.pins"
done
grep '^torch==' "$work/test.in" > requirements/torch.txt
