"""Audit log, events, leases, tokens and logins."""
