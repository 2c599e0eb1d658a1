"""Work in a thread of its own that asks for something now and then, and stands still until it is answered."""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue
from threading import Thread

from sylpose.network.membership import Answer, Ask

__all__ = ["Talk", "Work"]

# Work, given how it asks: see `Node`.
Work = Callable[[Callable[[Ask, int], Answer]], None]


class Talk:
    """A node's work. `through`: it has ended.

    Args:
        on_ask: called in its thread when it asks for something, or ends.
    """

    def __init__(self, work: Work, on_ask: Callable[[], None] = lambda: None) -> None:
        self.through, self._on_ask = False, on_ask
        self._asks: SimpleQueue[tuple[Ask, int] | BaseException | None] = SimpleQueue()
        self._answers: SimpleQueue[Answer | None] = SimpleQueue()
        self._thread = Thread(target=self._run, args=(work,), daemon=True)
        self._thread.start()

    def _run(self, work: Work) -> None:
        try:
            work(self._ask)
            self._asks.put(None)
        except BaseException as error:
            # Raised where the work is waited for.
            self._asks.put(error)
        self._on_ask()

    def _ask(self, ask: Ask, frames: int) -> Answer:
        self._asks.put((ask, frames))
        self._on_ask()
        answer = self._answers.get()
        if answer is None:
            raise SystemExit
        return answer

    def asks(self, wait: bool = True) -> tuple[Ask, int] | None:
        """What it asks for next, and after how many frames; None when it is through or, unless it is waited for, at work.

        Raises:
            Exception: that ended it.
        """
        try:
            said = self._asks.get(wait)
        except Empty:
            return None
        if isinstance(said, BaseException):
            self.through = True
            raise said
        self.through = said is None
        return said

    def hears(self, answer: Answer) -> None:
        """It goes on with an answer."""
        self._answers.put(answer)

    def end(self, *, wait: bool = True) -> None:
        """Ends it where it stands, or where it asks next."""
        self._answers.put(None)
        if wait:
            self._thread.join()
