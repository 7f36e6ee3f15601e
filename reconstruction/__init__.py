"""Calibrated geometry, capture folders, and strands from images.

    from reconstruction import Capture, Model, reconstruct

    reconstruct(Capture("captures/wig"), Model("models/wig"))

Public names are imported lazily; `__init__.pyi` lists them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
