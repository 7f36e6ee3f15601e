"""Errors of requests for a model's view."""


class NothingToView(LookupError):
    """The model, the capture or the part of it is missing; the message names it."""


class BadLight(ValueError):
    """Light, a view or an environment map that cannot be used; the message says why."""
