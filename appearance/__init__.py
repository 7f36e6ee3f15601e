"""Everything Mitsuba: scenes of hair, renderers, fits of the hair BSDF, image metrics."""
