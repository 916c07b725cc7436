"""Calls that workers are sent, each done once whatever happens to them."""

from __future__ import annotations

import asyncio
import queue
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any

from dask import config
from distributed import Client, Future, KilledWorker

from .worker import Outcome

#: Seconds without a result after which a worker that has work is taken for hung.
TIME_LIMIT = 300.0
#: Seconds that a cluster may be without any worker.
PATIENCE = 60.0
#: Seconds in which a worker that does well answers a question, and a scheduler.
ANSWER = 20.0
#: How often a call may hang or get lost before it's given up.
MOST_TRIES = 4
#: Seconds between looks at what workers do.
PERIOD = 1.0


def results(
    client: Client,
    function: Callable[..., Outcome],
    calls: Sequence[tuple],
    time_limit: float = TIME_LIMIT,
    lacking: Callable[[int], Any] = lambda index: None,
) -> Iterator[tuple[int, Any]]:
    """The values of ``function(*call)`` for all calls, each once, with their indices, as they end.

    Calls that are appended while it's used are done as well. Where a worker answers that it lacks
    something, the call is sent again with ``lacking(index)`` as its last argument.

    What a worker had that died, hung or ran out of memory is done again by another one. Raises
    ``RuntimeError``, in one line, if workers report a fault, or die or hang at the same call again
    and again, or if none is left.
    """
    crew = _Crew(client, function, calls, time_limit, lacking)
    try:
        sent = 0
        while crew.pending or sent < len(calls):
            for index in range(sent, len(calls)):
                crew.submit(index)
            sent = len(calls)
            yield from crew.arrived()
            crew.look_after_workers()
    finally:
        crew.dismiss()


class _Crew:
    """Workers, and the calls that they have.

    pending   future of each call that hasn't ended
    tries     how often each call has been lost
    since     when each worker that has work was last known to do well
    hung      workers that get nothing unless they answer after all
    """

    def __init__(self, client, function, calls, time_limit, lacking):
        self.client, self.function, self.calls = client, function, calls
        self.time_limit, self.lacking = time_limit, lacking
        self.pending: dict[int, Future] = {}
        self.tries: Counter[int] = Counter()
        self.since: dict[str, float] = {}
        self.hung: set[str] = set()
        self.last_look = self.last_worker = time.monotonic()
        self._abandoned: list[Future] = []
        self._ended: queue.SimpleQueue[tuple[int, Future]] = queue.SimpleQueue()

    def submit(self, index: int, *more: Any) -> None:
        """Send a call, with ``more`` arguments, to any worker that isn't hung."""
        others = workers_of(self.client).keys() - self.hung if self.hung else None
        future = self.client.submit(
            self.function,
            *self.calls[index],
            *more,
            pure=False,
            retries=MOST_TRIES - 1,
            workers=sorted(others) if others else None,
            allow_other_workers=bool(others),  # Should they all die.
        )
        self.pending[index] = future
        future.add_done_callback(lambda done: self._ended.put((index, done)))

    def arrived(self) -> Iterator[tuple[int, Any]]:
        """What has ended by now, or does within a moment."""
        wait = PERIOD
        while True:
            try:
                index, future = self._ended.get(timeout=wait)
            except queue.Empty:
                return
            wait = 0.0
            # Where another worker has been asked since, it's the first answer that counts.
            last = self.pending.get(index) is future
            outcome = self._outcome(index, future) if last or future.status == "finished" else None
            if outcome is not None:
                self.hung.discard(outcome.worker)
                self.since[outcome.worker] = self.last_worker = time.monotonic()
                if outcome.lacks:
                    self._complete(index, future)
                elif self.pending.pop(index, None):
                    yield index, outcome.value
            if time.monotonic() - self.last_look > PERIOD:
                return

    def _outcome(self, index: int, future: Future) -> Outcome | None:
        """What a worker has answered; None if the call has been sent again."""
        if future.status == "error":
            error = future.exception()
            if isinstance(error, KilledWorker):
                raise RuntimeError(
                    f"{error.last_worker.address}: workers die of the same part of the picture, "
                    "this one last; see its log, or give it more memory"
                )
            raise RuntimeError(f"a worker failed: {' '.join(str(error).split())}; see its log")
        try:
            outcome = future.result(timeout=self.time_limit)
        except Exception as error:  # Lost with the worker that had it.
            if self.pending.get(index) is future:
                self._again(index, f"results get lost ({type(error).__name__})")
            return None
        if outcome.fault:
            raise RuntimeError(f"worker {outcome.worker}: {outcome.fault}")
        return outcome

    def _complete(self, index: int, future: Future) -> None:
        """Send a call with what the worker that got it lacks."""
        if self.pending.get(index) is future:
            with config.set({"distributed.admin.large-graph-warning-threshold": "1TB"}):
                self.submit(index, self.lacking(index))

    def _again(self, index: int, reason: str) -> None:
        self.tries[index] += 1
        if self.tries[index] >= MOST_TRIES:
            raise RuntimeError(f"{reason}, {MOST_TRIES} times; see the logs of the workers")
        # Not cancelled: a hung worker would get the next call at once.
        self._abandoned.append(self.pending.pop(index))
        self.submit(index)

    def look_after_workers(self) -> None:
        """Take work from workers that hang; complain if there are none."""
        now = time.monotonic()
        if now - self.last_look < PERIOD:
            return
        self.last_look = now
        if self.client.status != "running":
            raise RuntimeError(f"{_address(self.client)}: the scheduler is gone; start it again")
        workers = workers_of(self.client)
        paused = {worker for worker, its in workers.items() if its.get("status") == "paused"}
        if workers.keys() - self.hung - paused:
            self.last_worker = now
        elif now - self.last_worker > PATIENCE:
            if paused:
                raise RuntimeError(
                    f"worker {min(paused)}: has stopped short of its memory limit; give it more: "
                    "dask worker --memory-limit"
                )
            raise RuntimeError(f"{_address(self.client)}: no worker is left; start some there")
        indices = {future.key: index for index, future in self.pending.items()}
        busy = {
            worker: [indices[key] for key in keys if key in indices]
            for worker, keys in _ask_scheduler(self.client, "processing", workers=None).items()
        }
        self.since = {
            worker: self.since.get(worker, now) for worker, theirs in busy.items() if theirs
        }
        for worker, since in self.since.items():
            # Dask lets none begin anything that is paused, and none goes on that has no memory.
            limit = min(self.time_limit, PATIENCE) if worker in paused else self.time_limit
            if now - since > limit:
                self._give_up(worker, busy[worker], limit)

    def _give_up(self, worker: str, indices: list[int], limit: float) -> None:
        self.hung.add(worker)
        for index in indices:
            self._again(index, f"worker {worker}: no result within {limit:g} s")

    def dismiss(self) -> None:
        """Forget what hasn't ended."""
        left = [*self.pending.values(), *self._abandoned]
        if left and self.client.status == "running":
            with suppress(asyncio.TimeoutError):
                self.client.sync(self._cancel, left, callback_timeout=ANSWER)

    async def _cancel(self, futures: list[Future]) -> None:
        await self.client.cancel(futures, force=True)


def workers_of(client: Client) -> dict[str, dict]:
    """What Dask tells of each worker there is, by address.

    Raises ``RuntimeError`` if the scheduler doesn't answer.
    """
    return _ask_scheduler(client, "identity", n_workers=-1).get("workers", {})


def _ask_scheduler(client: Client, question: str, **about: Any) -> dict[str, Any]:
    async def ask() -> dict[str, Any]:
        return await getattr(client.scheduler, question)(**about)

    try:
        return client.sync(ask, callback_timeout=PATIENCE)
    except asyncio.TimeoutError:
        raise RuntimeError(
            f"{_address(client)}: the scheduler doesn't answer; start it again"
        ) from None
    except OSError:  # It has gone: the client will know in a moment.
        return {}


def ask_workers(client: Client, function: Callable, *arguments: Any) -> dict[str, Any]:
    """Call a function on all workers there are: what each returns or raises, by address.

    Those that don't answer within ``ANSWER`` seconds count as gone, by an ``OSError``.
    """

    async def ask(worker: str) -> Any:
        asked = client.run(function, *arguments, workers=[worker], on_error="return")
        try:
            return (await asyncio.wait_for(asked, ANSWER)).get(worker)
        except (asyncio.TimeoutError, OSError) as error:
            return OSError(f"no answer ({error})")

    async def ask_all(workers: Iterable[str]) -> dict[str, Any]:
        return dict(zip(workers, await asyncio.gather(*map(ask, workers)), strict=True))

    return client.sync(ask_all, workers_of(client).keys())


def _address(client: Client) -> str:
    return client.scheduler.address if client.scheduler else "the cluster"
