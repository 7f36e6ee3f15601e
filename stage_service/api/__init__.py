"""The HTTP API: thin routes over `service.Service`, which does not depend on HTTP."""
