"""The HTTP face of the service: thin routes over `service.Service`, which knows no HTTP."""
