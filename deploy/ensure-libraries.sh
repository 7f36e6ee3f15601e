#!/bin/sh
# Find what Mitsuba's wheel loads and Debian may lack, or install it: libatomic, and libLLVM >= 16,
# which Dr.Jit compiles its kernels with.
set -eu
here="$(dirname "$0")"
bin="$here/../.venv/bin"
"$bin/python" -m appearance.scene.backend >/dev/null 2>&1 && exit 0
"$bin/python" -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' 2>/dev/null \
  || "$here/install-debian-package.sh" libatomic1
"$bin/python" -m appearance.scene.backend >/dev/null 2>&1 && exit 0
for version in 19 20 18 17 16; do
  for package in "libllvm$version" "libllvm${version}t64"; do
    if "$here/install-debian-package.sh" "$package" 2>/dev/null; then
      "$bin/python" -m appearance.scene.backend && exit 0
    fi
  done
done
exec "$bin/python" -m appearance.scene.backend # says in one sentence what to install
