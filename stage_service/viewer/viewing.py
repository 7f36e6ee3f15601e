"""Viewed models by name, and a cache of the latest."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any

from stage_service.decoding import Decoder
from stage_service.viewer.operations import OPERATIONS, Source
from stage_service.viewer.tracer import Tracer
from stage_service.viewer.viewed import Viewed

CACHED = 2


class Cache:
    """The latest models; `open_model` reads one by its key (or raises `LookupError`)."""

    def __init__(self, open_model: Callable[[Any], Viewed]) -> None:
        self._open = open_model
        self._cached: OrderedDict[Hashable, tuple[object, Viewed]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, name: Hashable) -> Viewed:
        """The model of that name, read again if its files have changed."""
        with self._lock:
            found = self._cached.get(name)
            if found is None or found[0] != _version(found[1]):
                viewed = self._open(name)
                found = _version(viewed), viewed
                self._cached[name] = found
            self._cached.move_to_end(name)
            while len(self._cached) > CACHED:
                self._cached.popitem(last=False)
            return found[1]


class Viewing:
    """Models by name: `names` lists them, `open_model` reads one (or raises `LookupError`);
    `decoder` decodes environment maps."""

    def __init__(
        self,
        names: Callable[[], list[str]],
        open_model: Callable[[str], Viewed],
        decoder: Decoder,
    ) -> None:
        self.names, self.decoder = names, decoder
        self._models = Cache(open_model)

    def get(self, name: str) -> Viewed:
        """The model of that name, read again if its files have changed."""
        return self._models.get(name)

    def do(self, name: str, operation: str, *, yields: bool = False, **options: Any) -> Any:
        """The result of one of `OPERATIONS`, bytes or JSON-ready. With `yields` it may be stopped
        for a capture. Raises `LookupError`, `BadLight`, `ModelError`, `CaptureError`."""
        return OPERATIONS[operation](self.get(name), **options)


class RemoteViewing(Viewing):
    """The same in the process of a `tracer`; `find` locates a model."""

    def __init__(
        self,
        names: Callable[[], list[str]],
        find: Callable[[str], Source],
        decoder: Decoder,
        tracer: Tracer,
    ) -> None:
        super().__init__(names, lambda name: find(name).open(), decoder)
        self._find, self._tracer = find, tracer

    def do(self, name: str, operation: str, *, yields: bool = False, **options: Any) -> Any:
        """As `Viewing.do`; raises `TracerStopped` besides."""
        return self._tracer.do(self._find(name), operation, options, yields=yields)


def _version(viewed: Viewed) -> object:
    """Modification times, which change when the model is made or fitted again."""
    files = (viewed.model.file(n) for n in ("strands.npz", "appearance.json", "hair_maps.npz"))
    return [f.stat().st_mtime_ns if f.exists() else None for f in files]
