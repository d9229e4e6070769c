#!/bin/sh
# Makes the base image of the Dockerfile where no image registry can be reached (root, debootstrap):
# Debian bookworm without documentation, manuals and translations, as debian:bookworm-slim is.
set -eu
name=debian:bookworm-slim
if docker image inspect "$name" >/dev/null 2>&1; then
	echo "$name is there"
	exit 0
fi
root=$(mktemp -d)
trap 'rm -rf "$root"' EXIT
debootstrap --variant=minbase bookworm "$root/base" "${DEBIAN_MIRROR:-http://deb.debian.org/debian}"
cd "$root/base"
rm -rf var/cache/apt/* var/lib/apt/lists/* var/log/*.log \
	usr/share/doc/* usr/share/info/* usr/share/man/* usr/share/locale/*
tar -c . | docker import -c 'CMD ["bash"]' - "$name"
