"""Commands that run a stage: its processes, captures and jobs."""
