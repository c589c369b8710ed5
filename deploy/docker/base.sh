#!/usr/bin/env bash
# Makes a base image from Debian's packages, for machines that reach no image registry:
#
#     deploy/docker/base.sh [TAG]      # isodream-base:local
#
# Needs root, debootstrap and a Docker daemon. Does nothing if the image is there; `docker rmi TAG` to make it anew.
# MIRROR=URL takes the packages from there instead of from debootstrap's default.
set -euo pipefail
umask 022

# The Debian of this machine, because binaries that are built here ask for its glibc or a newer one.
# shellcheck source=/dev/null
suite=$(. /etc/os-release && [ "${ID:-}" = debian ] && echo "${VERSION_CODENAME:-bookworm}" || echo bookworm)
tag=${1:-isodream-base:local}

missing() {
    echo "base.sh: $1" >&2
    exit 1
}
command -v docker >/dev/null || missing "docker is missing: install it (Debian, Ubuntu: apt-get install docker.io)"
docker info >/dev/null 2>&1 || missing "no Docker daemon answers: start it (systemctl start docker, or dockerd as root)"
if docker image inspect "$tag" >/dev/null 2>&1; then
    echo "base.sh: $tag is there"
    exit 0
fi
command -v debootstrap >/dev/null || missing "debootstrap is missing: install it (Debian, Ubuntu: apt-get install debootstrap)"
[ "$(id -u)" = 0 ] || missing "debootstrap needs root: run this script with sudo, once; after that everything goes without"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
root=$work/root
log=$work/log
if ! debootstrap --variant=minbase "$suite" "$root" ${MIRROR:+"$MIRROR"} >"$log" 2>&1; then
    tail -n 20 "$log" "$root/debootstrap/debootstrap.log" >&2 || true
    missing "debootstrap cannot make $suite: does this machine reach Debian's packages?"
fi

# What a process in a container has no use for: half of the size.
rm -rf "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/* "$root"/var/log/* \
    "$root"/usr/share/{doc,info,locale,man}/*
tar -C "$root" --numeric-owner -c . | docker import --change 'CMD ["bash"]' - "$tag" >/dev/null
docker image inspect --format "base.sh: made $tag, {{.Size}} bytes" "$tag"
