"""Worker thread that submits requests and blocks until each is answered."""

from __future__ import annotations

from collections.abc import Callable
from queue import Empty, SimpleQueue
from threading import Thread

from sylpose.network.membership import Request, Response

__all__ = ["Work", "WorkerThread"]

# Work function, called with the function that submits requests; see `Node`.
Work = Callable[[Callable[[Request, int], Response]], None]


class WorkerThread:
    """Thread of a node's work.

    Args:
        work: the function to run.
        on_request: called in the thread for each request, and at the end.

    Attributes:
        is_finished: whether the work has ended.
    """

    def __init__(self, work: Work, on_request: Callable[[], None] = lambda: None) -> None:
        self.is_finished, self._on_request = False, on_request
        self._requests: SimpleQueue[tuple[Request, int] | BaseException | None] = SimpleQueue()
        self._responses: SimpleQueue[Response | None] = SimpleQueue()
        self._thread = Thread(target=self._run, args=(work,), daemon=True)
        self._thread.start()

    def _run(self, work: Work) -> None:
        try:
            work(self._submit)
            self._requests.put(None)
        except BaseException as error:
            # Raised in the waiting thread.
            self._requests.put(error)
        self._on_request()

    def _submit(self, request: Request, frames: int) -> Response:
        self._requests.put((request, frames))
        self._on_request()
        response = self._responses.get()
        if response is None:
            raise SystemExit
        return response

    def next_request(self, wait: bool = True) -> tuple[Request, int] | None:
        """Return the next request and the number of tracked frames.

        Returns None if the work has ended or, without `wait`, is busy.

        Raises:
            Exception: the exception that ended the work.
        """
        try:
            request = self._requests.get(wait)
        except Empty:
            return None
        if isinstance(request, BaseException):
            self.is_finished = True
            raise request
        self.is_finished = request is None
        return request

    def respond(self, response: Response) -> None:
        """Resume the work with the answer to its request."""
        self._responses.put(response)

    def stop(self, *, wait: bool = True) -> None:
        """Stop the work at its pending or next request."""
        self._responses.put(None)
        if wait:
            self._thread.join()
