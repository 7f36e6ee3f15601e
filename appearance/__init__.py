"""Everything Mitsuba: scenes of hair, renderers, fits of the hair BSDF, image metrics.

Importing it registers the plugin `extended_hair`; a variant may be set before or after.
"""

import reconstruction.libllvm  # noqa: F401, before Mitsuba is imported

# isort: split
from appearance.bsdf import register

register()
