"""What commands print: results on stdout, progress on stderr."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from typing import Any

from reconstruction import Progress

LINE_EVERY_S = 10.0
"""Where progress goes to a log, a line so often."""


class Output:
    """Prints one JSON object on stdout, or text for people."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json

    def result(self, data: dict[str, Any], text: Any = None) -> None:
        """Print a command's result: `data` as JSON, or `text` (a string or a rich renderable)."""
        if self.as_json:
            print(json.dumps(data, allow_nan=False), flush=True)
            return
        from rich.console import Console

        shown = json.dumps(data, indent=1, allow_nan=False) if text is None else text
        # A table in a file or a log has no window to fit.
        width = None if sys.stdout.isatty() else 120
        Console(width=width, highlight=False).print(shown, markup=False, soft_wrap=True)

    def error(self, kind: str, detail: str, **more: Any) -> None:
        """Say what went wrong: on stderr, and with --json as the one object on stdout too."""
        if self.as_json:
            print(json.dumps({"error": {"type": kind, "detail": detail, **more}}), flush=True)
        print(f"hairstage: {detail}", file=sys.stderr, flush=True)

    def note(self, text: str) -> None:
        """A line for people, on stderr."""
        print(text, file=sys.stderr, flush=True)


@contextlib.contextmanager
def progress_bar(title: str) -> Iterator[Progress]:
    """A `Progress` that draws a bar on stderr; no terminal there: now and then a line."""
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bars

    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines(title)
        return
    with Bars(
        TextColumn("{task.fields[title]:<12}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
        console=console,
    ) as bars:
        task = bars.add_task("", total=1.0, title=title)

        def show(what: str, share: float) -> None:
            bars.update(task, description=what, completed=share)

        yield show


def _lines(title: str) -> Progress:
    last = [float("-inf")]

    def show(what: str, share: float) -> None:
        now = time.monotonic()
        if now - last[0] >= LINE_EVERY_S or share >= 1:
            print(f"{title}: {share:4.0%} {what}", file=sys.stderr, flush=True)
            last[0] = now if share < 1 else float("inf")

    return show
