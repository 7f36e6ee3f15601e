"""The captures of one stage: begun, steered, queued, listed."""
