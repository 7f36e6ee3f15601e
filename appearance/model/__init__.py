"""A model's appearance, whole: rendered, relit, judged, edited, exported."""
