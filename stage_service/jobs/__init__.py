"""Background work on captures: a durable queue, its pipelines and the worker process."""
