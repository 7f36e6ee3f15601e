#!/bin/sh
# Install one Debian package, as root or through sudo, or say what to do.
set -eu
if [ "$(id -u)" = 0 ]; then sudo=; elif command -v sudo >/dev/null; then sudo=sudo; else
  echo "hairstage needs the Debian package $1: run 'apt-get install $1' as root" >&2; exit 1
fi
export DEBIAN_FRONTEND=noninteractive
$sudo apt-get install -y -q "$1" >/dev/null 2>&1 \
  || { $sudo apt-get update -q >/dev/null 2>&1 || true; $sudo apt-get install -y -q "$1" >/dev/null; }
