"""The operator's console: web pages that use the HTTP API."""
