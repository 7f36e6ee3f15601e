"""What an installed hairstage needs besides modules must be in its wheel."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIST = """\
from setuptools import Distribution

distribution = Distribution({"script_name": "setup.py"})
distribution.parse_config_files()
build = distribution.get_command_obj("build_py")
build.ensure_finalized()
print(*build.get_outputs(include_bytecode=False), sep="\\n")
"""


def test_the_wheel_has_every_module_the_rigs_and_the_types():
    done = subprocess.run(
        [sys.executable, "-c", LIST], cwd=ROOT, capture_output=True, text=True, check=True
    )
    built = {str(Path(line).relative_to("build/lib")) for line in done.stdout.split()}
    packages = ("reconstruction", "appearance", "stage_service", "simulators")
    ours = [p for name in packages for p in (ROOT / name).rglob("*") if p.is_file()]
    wanted = {str(p.relative_to(ROOT)) for p in ours if "__pycache__" not in p.parts}
    assert built == wanted
    assert {f"{name}/py.typed" for name in packages} <= built
    assert {f"stage_service/rigs/{name}.toml" for name in ("demo", "stage331")} <= built
