"""Geometry from planes of light (Photobooth §3.1): triangulation, conditioning and motion."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
