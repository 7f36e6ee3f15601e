"""Separate thread pools, so that urgent requests do not wait for others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Annotated, ParamSpec, TypeVar

from anyio import CapacityLimiter, fail_after, to_thread
from fastapi import Depends, Request

from stage_service.jobs.queue import JobsUnavailable

P = ParamSpec("P")
T = TypeVar("T")
DATABASE_S = 10.0
"""Timeout of the job database."""


class Lanes:
    """Thread pools by what their work may wait for."""

    def __init__(self) -> None:
        self._dark, self._health, self._devices = (CapacityLimiter(n) for n in (64, 16, 64))
        self._jobs = CapacityLimiter(8)

    async def dark(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For abort and blackout, which wait only for lamps and projectors."""
        return await to_thread.run_sync(partial(work, *args, **more), limiter=self._dark)

    async def health(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For work that does not wait."""
        return await to_thread.run_sync(partial(work, *args, **more), limiter=self._health)

    async def devices(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For work that queries devices."""
        return await to_thread.run_sync(partial(work, *args, **more), limiter=self._devices)

    async def jobs(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For queries of the job database. Raises `JobsUnavailable` after `DATABASE_S`."""
        try:
            with fail_after(DATABASE_S):
                return await to_thread.run_sync(
                    partial(work, *args, **more), limiter=self._jobs, abandon_on_cancel=True
                )
        except TimeoutError:
            raise JobsUnavailable(
                f"the job database or disk did not respond within {DATABASE_S:g} s: the request "
                "may "
                "still be carried out, check before you repeat it"
            ) from None


async def lanes_of(request: Request) -> Lanes:
    """The lanes of this application."""
    lanes: Lanes = request.app.state.lanes
    return lanes


OnLanes = Annotated[Lanes, Depends(lanes_of)]
