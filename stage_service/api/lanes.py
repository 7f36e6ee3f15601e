"""Threads of their own for what must be answered whatever all other requests wait for."""

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
"""A job database that has not answered by then counts as away."""


class Lanes:
    """By what they may have to wait for; one never waits for the threads of another."""

    def __init__(self) -> None:
        self._dark, self._health, self._devices = (CapacityLimiter(n) for n in (64, 16, 64))
        self._jobs = CapacityLimiter(8)

    async def dark(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For abort and blackout, which wait for lamps and projectors alone."""
        return await to_thread.run_sync(partial(work, *args, **more), limiter=self._dark)

    async def health(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For what waits for nothing."""
        return await to_thread.run_sync(partial(work, *args, **more), limiter=self._health)

    async def devices(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For what gives devices a moment to answer."""
        return await to_thread.run_sync(partial(work, *args, **more), limiter=self._devices)

    async def jobs(self, work: Callable[P, T], *args: P.args, **more: P.kwargs) -> T:
        """For what asks the job database. Raises `JobsUnavailable` where it takes too long."""
        try:
            with fail_after(DATABASE_S):
                return await to_thread.run_sync(
                    partial(work, *args, **more), limiter=self._jobs, abandon_on_cancel=True
                )
        except TimeoutError:
            raise JobsUnavailable(
                f"job database or disk has not answered within {DATABASE_S:g} s: what was asked "
                "may still be done, look before you ask again"
            ) from None


async def lanes_of(request: Request) -> Lanes:
    """The lanes of this application."""
    lanes: Lanes = request.app.state.lanes
    return lanes


OnLanes = Annotated[Lanes, Depends(lanes_of)]
