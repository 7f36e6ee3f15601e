"""The HTTP face of the service: thin routes over `stage.Stage`, which knows no HTTP."""
