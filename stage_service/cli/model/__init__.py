"""Commands that work on a model on disk, without a service."""
