"""Everything Mitsuba: scenes of hair, renderers, fits of the hair BSDF, image metrics.

Importing it registers the plugin `extended_hair`; a variant may be set before or after.
"""

from appearance.bsdf import register

register()
