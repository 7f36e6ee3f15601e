"""Which models are looked at; the few that were last are kept in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

from stage_service.decoding import Decoder
from stage_service.viewer.viewed import Viewed

KEPT = 2


class Viewing:
    """Models by name: `names` lists them, `open_model` reads one (or raises `LookupError`);
    `decoder` is for maps that they are lit by."""

    def __init__(
        self,
        names: Callable[[], list[str]],
        open_model: Callable[[str], Viewed],
        decoder: Decoder,
    ) -> None:
        self.names, self._open, self.decoder = names, open_model, decoder
        self._kept: OrderedDict[str, tuple[object, Viewed]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, name: str) -> Viewed:
        """The model of that name, read anew where its strands have changed."""
        with self._lock:
            found = self._kept.get(name)
            if found is None or found[0] != _version(found[1]):
                viewed = self._open(name)
                found = _version(viewed), viewed
                self._kept[name] = found
            self._kept.move_to_end(name)
            while len(self._kept) > KEPT:
                self._kept.popitem(last=False)
            return found[1]


def _version(viewed: Viewed) -> object:
    """What changes when the model is made or fitted again."""
    files = (viewed.model.file(n) for n in ("strands.npz", "appearance.json", "hair_maps.npz"))
    return [f.stat().st_mtime_ns if f.exists() else None for f in files]
