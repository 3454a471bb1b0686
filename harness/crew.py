"""Several workers at once, each with a thread that looks after it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from queue import SimpleQueue
from typing import Self, TypeVar

from harness.worker import Worker

Task = TypeVar("Task")


class Crew:
    """So many workers; on leaving the block they are gone, with all that they started."""

    def __init__(self, size: int) -> None:
        self.workers = [Worker() for _ in range(size)]
        self._idle: SimpleQueue[Worker] = SimpleQueue()
        for worker in self.workers:
            self._idle.put(worker)
        self._stopping = threading.Event()

    def stopped(self) -> bool:
        """True once the block is being left while calls are still running."""
        return self._stopping.is_set()

    def each(self, do: Callable[[Task, Worker], None], tasks: Iterable[Task]) -> Generator[Task, None, None]:
        """The tasks, as `do(task, worker)` comes to an end for each, as many at a time as there are workers.

        `do` runs in a thread of its own. What it raises comes through here, as does KeyboardInterrupt; then, too, calls
        that still run are ended; so they are when the generator is closed early, which the caller has to see to.
        """

        def with_a_worker(task: Task) -> None:
            worker = self._idle.get()
            try:
                if not self.stopped():
                    do(task, worker)
            finally:
                self._idle.put(worker)

        with ThreadPoolExecutor(len(self.workers), "crankbench-worker") as threads:
            waiting: dict[Future[None], Task] = {}
            try:
                waiting |= {threads.submit(with_a_worker, task): task for task in tasks}
                for future in as_completed(waiting):
                    future.result()
                    yield waiting[future]
            finally:
                self._stopping.set()
                threads.shutdown(cancel_futures=True)
                self._stopping.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        for worker in self.workers:
            worker.close()
