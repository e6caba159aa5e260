"""Where a campaign's tasks are done: here, in processes of this machine, or by a Dask cluster. A worker that dies loses nothing."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

from haltere.errors import HaltereError
from haltere.evaluate.campaign_run import Result, Task, crashed, warm, work

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor

__all__ = ["by_dask", "here", "processes"]

#: Tasks that wait a worker, so that none is ever idle.
AHEAD = 3
#: Threads of the libraries of a worker: there are as many workers as cores.
_ALONE = {k: "1" for k in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "POLARS_MAX_THREADS", "NUMBA_NUM_THREADS")}


def here(tasks: Sequence[Task]) -> Iterator[list[Result]]:
    """Results in this process, task by task."""
    for task in tasks:
        yield work(task)


# --- processes -----------------------------------------------------------------------------------------------------------


def _begin() -> None:
    """In a worker at its start: an interrupt is for the parent to handle, and a worker without its parent ends."""
    import multiprocessing
    from multiprocessing.connection import wait

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:

        def watch() -> None:
            wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Worker processes that end with the block, whatever they are doing."""
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    before = {k: os.environ.get(k) for k in _ALONE}
    os.environ.update(_ALONE)
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _begin)
    finished = False
    try:
        yield pool
        finished = True
    finally:
        children = list((getattr(pool, "_processes", None) or {}).values())
        pool.shutdown(wait=finished, cancel_futures=True)
        if not finished:
            for child in children:
                child.terminate()
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def processes(tasks: Sequence[Task], workers: int, estimators: Sequence[str]) -> Iterator[list[Result]]:
    """Results from worker processes, as they come.

    Kernels are compiled once, by one worker, before the others load them. When a worker dies, the tasks that were under way are done
    again one run after the other, so that the run that kills it is found: it becomes a row, and the others lose nothing.
    """
    from concurrent.futures import FIRST_COMPLETED, Future, wait
    from concurrent.futures.process import BrokenProcessPool

    waiting = deque(tasks)
    while waiting:
        doing: dict[Future[list[Result]], Task] = {}
        suspects: list[Task] = []
        with _pool(min(workers, len(waiting))) as pool:
            try:
                pool.submit(warm, estimators, True).result()
                while waiting or doing:
                    while waiting and len(doing) < AHEAD * workers:
                        doing[pool.submit(work, waiting[0])] = waiting[0]
                        waiting.popleft()
                    for future in wait(doing, return_when=FIRST_COMPLETED).done:
                        yield future.result()
                        del doing[future]
            except BrokenProcessPool:
                for future, task in doing.items():
                    if future.done() and not future.cancelled() and future.exception() is None:
                        yield future.result()
                    else:
                        suspects.append(task)
                if not suspects and not doing and waiting:
                    raise HaltereError(
                        "worker processes", "one that died before its first run", "campaign", "try --workers 1, which tells more"
                    ) from None
        yield from _alone([single for task in suspects for single in task.parted()])


def _alone(tasks: Sequence[Task]) -> Iterator[list[Result]]:
    """Results of single runs of which one may kill its worker, each in a worker of which it is known."""
    from concurrent.futures.process import BrokenProcessPool

    left = deque(tasks)
    tries = 0
    while left:
        with _pool(1) as pool:
            try:
                while left:
                    yield pool.submit(work, left[0]).result()
                    left.popleft()
                    tries = 0
            except BrokenProcessPool:
                tries += 1
                if tries > 1:  # twice by itself: it is this run, not the memory that others took
                    yield crashed(left.popleft(), "the worker process died, twice (killed, or out of memory)")
                    tries = 0


# --- Dask ----------------------------------------------------------------------------------------------------------------


async def _answers(distributed: Any, address: str) -> None:
    """Reach the scheduler once."""
    comm = await distributed.comm.connect(address, timeout=5.0)
    await comm.close()


def by_dask(tasks: Sequence[Task], address: str) -> Iterator[list[Result]]:
    """Results from the workers of a Dask scheduler, as they come.

    The scheduler gives the tasks of a worker that dies to another. A task that took several workers with it is parted into its runs.

    Raises
    ------
    HaltereError
        Dask is not installed, no scheduler answers, it has no workers, or it is lost.
    """
    try:
        distributed: Any = import_module("distributed")  # optional, so that what it is is not known before
    except ImportError:
        raise HaltereError("Dask for --scheduler", "none installed", "campaign", 'pip install "haltere[dask]"') from None
    import logging

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    again = "finished runs are kept: the same command goes on from here"
    try:
        asyncio.run(_answers(distributed, address))  # a client that reaches no scheduler does not go quietly
        client = distributed.Client(address, timeout=15.0, set_as_default=False, name="haltere campaign")
    except (OSError, TimeoutError, ValueError) as error:
        found = str(error).splitlines()[0] if str(error) else "no answer"
        raise HaltereError("a Dask scheduler", found, address, "start one with: dask scheduler") from None
    try:
        try:
            client.wait_for_workers(1, timeout=30.0)
        except (TimeoutError, distributed.TimeoutError):
            raise HaltereError("workers of the scheduler", "none", address, f"start one with: dask worker {address}") from None
        asked: dict[Any, Task] = {}

        def ask(task: Task) -> Any:
            future = client.submit(work, task, pure=False, retries=2)
            asked[future] = task
            return future

        left = deque(tasks)
        room = max(64, AHEAD * sum(int(w["nthreads"]) for w in client.scheduler_info(n_workers=-1)["workers"].values()))
        finished = distributed.as_completed([ask(left.popleft()) for _ in range(min(room, len(left)))], loop=client.loop)
        for future in finished:
            task = asked.pop(future)
            more: list[Task] = []
            if future.status == "finished":
                yield future.result()
            elif future.status == "error":
                why = future.exception()
                if isinstance(why, HaltereError):
                    raise why
                if not isinstance(why, distributed.KilledWorker):
                    raise HaltereError("workers with the same haltere", f"{type(why).__name__}: {why}", address, again)
                if len(task.runs) > 1:
                    more = task.parted()
                else:
                    yield crashed(task, "the worker process died, several times (killed, or out of memory)")
            else:
                raise HaltereError("a scheduler that stays", f"one that {future.status} the work", address, again)
            future.release()
            if left and not more:
                more = [left.popleft()]
            for one in more:
                finished.add(ask(one))
    except (OSError, distributed.comm.CommClosedError) as error:
        raise HaltereError("a scheduler that stays", str(error).splitlines()[0], address, again) from None
    finally:
        with contextlib.suppress(Exception):  # whatever the scheduler's end, this one goes
            client.close(timeout=5.0)
