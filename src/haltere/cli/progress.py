"""Progress on stderr for what takes longer than a second; silent where stderr is no terminal. It knows no verb."""

from __future__ import annotations

import sys
import threading
import time
from types import TracebackType

__all__ = ["Progress"]

#: Before this many seconds nothing is shown; after so many more without a sample filtered, it must be compiling.
DELAY, COMPILING = 1.0, 2.0


class Progress:
    """Stages of a verb, each with a fraction where it is known; a context manager."""

    def __init__(self) -> None:
        self._words, self._fraction, self._compiles = "", 0.0, False
        self._began = time.monotonic()
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Progress:
        if sys.stderr.isatty():
            self._thread = threading.Thread(target=self._show, daemon=True)
            self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()

    def stage(self, words: str, compiles: bool = False) -> None:
        """Name what is done now; ``compiles`` where the first use of kernels may compile them."""
        self._words, self._fraction, self._compiles, self._began = words, 0.0, compiles, time.monotonic()

    def update(self, fraction: float, words: str | None = None) -> None:
        """Set the fraction done of this stage, and how it is to be named from now on."""
        self._fraction = fraction
        self._words = words or self._words

    def _show(self) -> None:
        """Draw until done; in a thread of its own, so that work without news still shows life."""
        if self._done.wait(DELAY):
            return
        from rich.console import Console
        from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.progress import Progress as Bar

        columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(bar_width=30), TimeElapsedColumn())
        with Bar(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(self._words, total=None)
            while not self._done.wait(0.1):
                waiting = self._compiles and self._fraction == 0.0 and time.monotonic() - self._began > COMPILING
                words = f"{self._words} (compiling the filter, on the first run only)" if waiting else self._words
                bar.update(task, description=words, total=1.0 if self._fraction > 0.0 else None, completed=self._fraction)
