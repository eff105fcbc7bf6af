"""The observer's web page: the newest picture and how things stand, for any browser; nothing can be changed from it.

A process of its own and a client like any other, without the lease and without a way to ask for it: what is not written
here cannot be done from a browser. Only the standard library serves it.
"""

from __future__ import annotations

import json
import logging
import math
import sys
import threading
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from acquire.client import Instrument
from acquire.preview import FRAMES_PER_S, preview
from devices.clock import SystemClock
from devices.errors import StereotomeError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from acquire.replies import Preview

log = logging.getLogger(__name__)
VIEWERS = 8
WATCHED_S = 5.0
TELL_EVERY_S = 1.0
BOUNDARY = "frame"
LOCAL = ("localhost", "127.0.0.1", "[::1]")
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; img-src 'self' data:; connect-src 'self'; "
    "style-src 'unsafe-inline'; script-src 'unsafe-inline'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class Newest:
    """The newest picture, made while somebody looks; one thread makes it, any number wait for it."""

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self._clock = SystemClock()
        self._changed = threading.Condition()
        self._picture: Preview | None = None
        self._taken_s = 0.0
        self._wanted_s = float("-inf")
        self.version = 0
        threading.Thread(target=self._run, name="pictures", daemon=True).start()

    def after(self, version: int, timeout_s: float) -> tuple[int, Preview | None]:
        """Wait for a picture newer than ``version``; return its version and it, the old one when none came."""
        with self._changed:
            self._wanted_s = self._clock.now()
            self._changed.wait_for(lambda: self.version > version, timeout_s)
            return self.version, self._picture

    @property
    def age_s(self) -> float | None:
        """How old the newest picture is; None before the first."""
        return self._clock.now() - self._taken_s if self._picture is not None else None

    def _run(self) -> None:
        with self._instrument.viewer() as viewer:
            while True:
                self._clock.sleep(1 / FRAMES_PER_S)
                if self._clock.now() - self._wanted_s > WATCHED_S:
                    viewer.close()
                elif (frame := viewer.newest(0)) is not None:
                    self._show(preview(frame))

    def _show(self, picture: Preview) -> None:
        with self._changed:
            self._picture, self._taken_s = picture, self._clock.now()
            self.version += 1
            self._changed.notify_all()


class Page:
    """What the handlers of all requests share."""

    def __init__(self, instrument: Instrument, hosts: tuple[str, ...], token: str) -> None:
        self.instrument = instrument
        self.newest = Newest(instrument)
        self.hosts = hosts
        self.prefix = f"/{token}" if token else ""
        self.places = threading.BoundedSemaphore(VIEWERS)
        self.html = files("acquire").joinpath("observer.html").read_bytes()

    def status(self) -> dict[str, Any]:
        """Return how things stand, for the page."""
        state = msgspec.to_builtins(self.instrument.state)
        picture = self.newest.after(0, 0)[1]
        shown = None
        if picture is not None:
            shown = msgspec.to_builtins(picture)
            shown |= {"jpeg": None, "z_um": None if math.isnan(picture.z_um) else picture.z_um}
        return {
            "instrument": self.instrument.welcome.instrument,
            "silent_s": round(self.instrument.silent_s, 1),
            "picture": shown,
            "picture_age_s": None if self.newest.age_s is None else round(self.newest.age_s, 1),
            **state,
        }


class Handler(BaseHTTPRequestHandler):
    """Answers GET for five places; everything else is not allowed, or not there."""

    protocol_version = "HTTP/1.1"
    server_version = "stereotome"
    sys_version = ""
    timeout = 30

    def __init__(self, page: Page, *given: Any) -> None:
        self._page = page
        super().__init__(*given)

    def do_GET(self) -> None:
        """Answer one of the places."""
        places: dict[str, Callable[[], None]] = {
            "/": partial(self._whole, "text/html; charset=utf-8", lambda: self._page.html),
            "/status.json": partial(self._whole, "application/json", lambda: _json(self._page.status())),
            "/frame.jpg": self._frame,
            "/stream.mjpg": partial(self._stream, f"multipart/x-mixed-replace; boundary={BOUNDARY}", self._pictures),
            "/events": partial(self._stream, "text/event-stream", self._events),
        }
        prefix, path = self._page.prefix, self.path.partition("?")[0]
        place = places.get(path.removeprefix(prefix)) if path.startswith(prefix) else None
        if not self._from_here() or place is None:
            self._refuse(HTTPStatus.NOT_FOUND)
        else:
            place()

    def _not_allowed(self) -> None:
        self.close_connection = True
        self._refuse(HTTPStatus.METHOD_NOT_ALLOWED)

    do_HEAD = do_POST = do_PUT = do_DELETE = do_PATCH = do_OPTIONS = _not_allowed  # noqa: N815

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002  the library's own name
        """Keep quiet: five pictures a second are no news."""

    def _from_here(self) -> bool:
        """Tell whether the page was asked for by a name of this computer: pages of others may not read it."""
        host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
        return bool(self._page.prefix) or host in self._page.hosts

    def _refuse(self, status: HTTPStatus) -> None:
        self._whole("text/plain; charset=utf-8", status.phrase.encode, status)

    def _whole(self, kind: str, make: Callable[[], bytes], status: HTTPStatus = HTTPStatus.OK) -> None:
        body = make()
        self._head(kind, status, {"Content-Length": str(len(body)), **({"Allow": "GET"} if status == 405 else {})})
        self.wfile.write(body)

    def _head(self, kind: str, status: HTTPStatus, more: dict[str, str]) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, **HEADERS, **more}.items():
            self.send_header(name, value)
        self.end_headers()

    def _frame(self) -> None:
        _, picture = self._page.newest.after(0, TELL_EVERY_S)
        if picture is None:
            self._refuse(HTTPStatus.NOT_FOUND)
        else:
            self._whole("image/jpeg", lambda: picture.jpeg)

    def _stream(self, kind: str, parts: Callable[[], Iterator[bytes]]) -> None:
        """Send part after part until the browser leaves; only so many at a time."""
        if not self._page.places.acquire(blocking=False):
            self._refuse(HTTPStatus.SERVICE_UNAVAILABLE)
            return
        try:
            self.close_connection = True
            self._head(kind, HTTPStatus.OK, {"Connection": "close"})
            for part in parts():
                self.wfile.write(part)
                self.wfile.flush()
        except OSError:  # it left
            pass
        finally:
            self._page.places.release()

    def _pictures(self) -> Iterator[bytes]:
        version = 0
        while True:
            newer, picture = self._page.newest.after(version, TELL_EVERY_S)
            if picture is not None and newer > version:
                version = newer
                head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture.jpeg)}\r\n\r\n"
                yield head.encode() + picture.jpeg + b"\r\n"

    def _events(self) -> Iterator[bytes]:
        while True:
            yield b"data: " + _json(self._page.status()) + b"\n\n"
            self._page.instrument.wait_for_change(TELL_EVERY_S)


def _json(value: object) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False, default=str).encode()


def main(arguments: list[str]) -> int:
    """Serve the page: CONNECTION HOST PORT TOKEN. Says the address on standard output; ends with standard input."""
    connection, host, port, token = arguments
    try:
        with Instrument.connect(Path(connection)) as instrument:
            page = Page(instrument, (*LOCAL, host), token)
            server = ThreadingHTTPServer((host, int(port)), partial(Handler, page))
            server.daemon_threads = True
            threading.Thread(target=server.serve_forever, daemon=True).start()
            sys.stdout.write(f"http://{host}:{server.server_port}{page.prefix}/\n")
            sys.stdout.flush()
            sys.stdin.read()
    except (StereotomeError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 4
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
