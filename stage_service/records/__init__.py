"""Who did what: audit, events, leases."""
