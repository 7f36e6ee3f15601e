"""Everything Mitsuba: scenes of hair, renderers, fits of the hair BSDF, image metrics.

Importing it registers the plugin `extended_hair`; a variant may be set before or after.
The names of `__init__.pyi` are loaded on first use.
"""

import reconstruction.libllvm  # noqa: F401, before Mitsuba is imported

# isort: split
import lazy_loader

from appearance.bsdf import register

register()

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
