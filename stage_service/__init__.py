"""Runs the stage: HTTP API, CLI, jobs, sequencing, device drivers.

from stage_service import CapturePlan, load_rig_file, resolve

resolve(CapturePlan(), load_rig_file("demo.toml")).cost

The names of `__init__.pyi` are loaded on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
