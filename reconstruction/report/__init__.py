"""Reports of pipeline stages: figures, plots, progress, memory."""
