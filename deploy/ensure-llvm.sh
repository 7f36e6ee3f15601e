#!/bin/sh
# Find libLLVM >= 16, which Dr.Jit compiles its kernels with, or install it.
set -eu
bin="$(dirname "$0")/../.venv/bin"
"$bin/python" -m appearance.scene.backend >/dev/null 2>&1 && exit 0
here="$(dirname "$0")"
for version in 19 20 18 17 16; do
  for package in "libllvm$version" "libllvm${version}t64"; do
    if "$here/install-debian-package.sh" "$package" 2>/dev/null; then
      "$bin/python" -m appearance.scene.backend && exit 0
    fi
  done
done
exec "$bin/python" -m appearance.scene.backend # says in one sentence what to install
