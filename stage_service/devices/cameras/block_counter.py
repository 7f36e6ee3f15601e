"""A camera's block ids as one count."""

from __future__ import annotations


class BlockCounter:
    """Counts frames from 1 by their block ids, across wraps and restarts.

    Ids run from `first` to `last`, begin again at `first`, and also do so with every `restart`.
    A gap of a whole round cannot be seen.
    """

    def __init__(self, first: int, last: int) -> None:
        self.first, self.last = first, last
        self.count = 0
        self._before = first - 1

    def restart(self) -> None:
        """The next frame's id is `first`."""
        self._before = self.first - 1

    def take(self, block_id: int) -> int | None:
        """The frame's number; an id that comes twice has the same twice. None: not an id."""
        if not self.first <= block_id <= self.last:
            return None
        self.count += (block_id - self._before) % (self.last - self.first + 1)
        self._before = block_id
        return self.count
