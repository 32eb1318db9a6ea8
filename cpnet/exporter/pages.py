"""A page of metrics over HTTP, for a few askers at a time."""

from __future__ import annotations

import logging
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from socketserver import ThreadingMixIn
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, make_wsgi_app

MAX_ASKERS = 16
SILENCE_S = 5.0  # of an asker, before it is hung up on
_PLACE_S = 1.0  # for an asker that was driven out to let go of its place
Asker = socket.socket | tuple[bytes, socket.socket]  # the latter for datagrams: never here
_log = logging.getLogger(__name__)


class PageServer(ThreadingMixIn, WSGIServer):
    """A thread for each asker; beyond the last place, a newcomer drives out the oldest.

    An answer takes milliseconds, so the oldest is one that does not ask. Were newcomers turned
    away instead, sixteen silent ones could keep everybody from the page.
    """

    daemon_threads = True

    def __init__(self, address: tuple[str, int], handler: type[WSGIRequestHandler]) -> None:
        """Listens there."""
        self._lock = threading.Lock()
        self._askers: list[Asker] = []  # the oldest first
        self._places = threading.BoundedSemaphore(MAX_ASKERS)
        super().__init__(address, handler)

    def process_request(self, request: Asker, client_address: object) -> None:
        """Serves an asker in a thread of its own, as soon as there is a place."""
        if not self._places.acquire(blocking=False):
            self._drive_out_oldest()
            if not self._places.acquire(timeout=_PLACE_S):
                self.shutdown_request(request)
                return
        with self._lock:
            self._askers.append(request)
        try:
            super().process_request(request, client_address)
        except BaseException:  # no thread began that would give the place back
            self._places.release()
            raise

    def process_request_thread(self, request: Asker, client_address: object) -> None:
        """Serves an asker and gives its place back."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._places.release()

    def shutdown_request(self, request: Asker) -> None:
        """Hangs up; nobody drives out who has left."""
        with self._lock:
            if request in self._askers:
                self._askers.remove(request)
        super().shutdown_request(request)

    def handle_error(self, *_: object) -> None:
        """Tells of a fault; an asker that is silent or gone is none."""
        if not isinstance(sys.exception(), OSError):
            _log.exception("the page of metrics went wrong")

    def _drive_out_oldest(self) -> None:
        with self._lock, suppress(OSError):  # it may have hung up
            oldest = self._askers.pop(0) if self._askers else None
            if isinstance(oldest, socket.socket):
                oldest.shutdown(socket.SHUT_RDWR)


class _Handler(WSGIRequestHandler):
    timeout = SILENCE_S

    def log_message(self, *_: object) -> None:
        """Says nothing of those who asked."""


@contextmanager
def serving_pages(host: str, port: int, registry: CollectorRegistry) -> Iterator[None]:
    """Serves the registry's page meanwhile.

    Raises:
        OSError: nobody can listen there.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]

    class Server(PageServer):
        address_family = found[0]

    app = make_wsgi_app(registry)
    with make_server(str(found[4][0]), port, app, Server, handler_class=_Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()
