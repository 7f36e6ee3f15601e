"""Runs the stage: HTTP API, CLI, jobs, sequencing, device drivers."""
