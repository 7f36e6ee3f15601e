"""Reports of what was done: figures, plots, memory."""
