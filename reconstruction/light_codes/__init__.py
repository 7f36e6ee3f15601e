"""Photometric line stereo: shadow bits match pixels across views, lines give segments (Sun §4)."""

import reconstruction.libllvm  # noqa: F401, before Dr.Jit is imported
