"""Capture plans: what to shoot, what it costs, and what a rig lets it do."""
