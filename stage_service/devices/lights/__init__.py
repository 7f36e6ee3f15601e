"""Light banks: the interface and its backends."""
