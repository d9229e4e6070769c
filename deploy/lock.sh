#!/bin/sh
# Pins what each set of deploy/requirements.py installs, with hashes, in requirements/*.txt.
# PYTHON must be a 3.11 with pip-tools. `test` has every package and is compiled first; the other
# sets are compiled under its pins and take their hashes from it. No file names an index. torch is
# pinned without a hash, in requirements/torch.txt: each index has its own build of one version.
# Pins stay where they still satisfy pyproject.toml; UPGRADE=1 takes the newest version of each.
set -eu
: "${PYTHON:=python3}"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p requirements
: > "$work/pins"
for name in test demo runtime full; do
	"$PYTHON" deploy/requirements.py $name > "$work/$name.in"
	if [ $name != test ]; then cp "$work/all.txt" "$work/locked.txt"
	elif [ "${UPGRADE:-0}" != 1 ]; then cp requirements/test.txt "$work/locked.txt"; fi
	"$PYTHON" -m piptools compile -q --generate-hashes --unsafe-package torch --strip-extras \
		--no-header --no-annotate --no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
		--no-emit-options -c "$work/pins" -o "$work/locked.txt" "$work/$name.in"
	grep -v '^#' "$work/locked.txt" | grep . > "requirements/$name.txt"
	[ $name = test ] || continue
	sed 's/ *\\$//; /^ *--hash/d' requirements/test.txt > "$work/pins"
	cp "$work/locked.txt" "$work/all.txt"
done
grep '^torch==' "$work/test.in" > requirements/torch.txt
# The fuzzer (`make fuzz`) and what builds the site (`make docs`), installed beside what is there.
for group in fuzz docs; do
	"$PYTHON" -c 'import sys, tomllib; g = tomllib.load(open("pyproject.toml", "rb"))["dependency-groups"]
print(*g[sys.argv[1]], sep="\n")' $group > "$work/$group.in"
	"$PYTHON" -m piptools compile -q --generate-hashes --strip-extras --no-header --no-annotate \
		--no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-emit-options \
		-c "$work/pins" -o "$work/$group.txt" "$work/$group.in"
	grep -v '^#' "$work/$group.txt" | grep . > "requirements/$group.txt"
done
