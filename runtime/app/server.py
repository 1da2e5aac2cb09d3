"""The server of a page: on this machine only, for clients with the link's token.

Takes: a factory of documents, one per tab; a port.
Gives: `bound`, a server and its link; `run`.
Guarantees: it listens on the loopback interface. Requests without the token, or from a page of another
origin, are refused on every path. Only the program's scripts are served as files. Sessions of tabs are
separate. Idle connections do not block others. The token is in no process's arguments.
Does not: define the page contents.
"""

from __future__ import annotations

import errno
import hmac
import logging
import secrets
import signal
import traceback
from asyncio import AbstractEventLoop
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import partial
from html import escape
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import TracebackType
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.auth_provider import AuthProvider
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop
from tornado.web import HTTPError

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

HOST = "127.0.0.1"
TOKEN = "token"  # the argument of the link that holds it

# Interval of the check for closed tabs, and the time after which they count as closed, in ms.
EVALUATED, CLOSED = 2_000, 10_000


# Largest number of connections that are not yet a tab's socket; beyond it the oldest is closed. A browser
# opens six. Seconds within which a request must be complete.
MOST, LOG_TEXT = 100, 10.0
FULL = (errno.EMFILE, errno.ENFILE)  # no descriptor is left to accept a connection with

# The file opened in the browser, with the link readable by its owner only.
LEADING = """<!DOCTYPE html><meta charset="utf-8"><title>apc explore</title>
<meta name="referrer" content="no-referrer"><meta http-equiv="refresh" content="0; url={link}">
<p><a href="{link}">The page of apc explore</a>
"""


class Door(HTTPServer):  # type: ignore[misc] # Tornado's types are not checked
    """Takes connections in; where there are too many the one that has waited longest goes."""

    def initialize(self, application: BokehTornado) -> None:
        """Initialize; Tornado calls this method as its constructor."""
        super().initialize(application, idle_connection_timeout=LOG_TEXT, body_timeout=LOG_TEXT)
        self.waiting: dict[Any, None] = {}

    def handle_stream(self, stream: Any, address: Any) -> None:
        """Take in a new connection."""
        if len(self.waiting) >= MOST:
            self.let_go()
        self.waiting[stream] = None
        super().handle_stream(stream, address)

    def on_close(self, server_conn: Any) -> None:
        """Forget a connection that was closed, or has become a tab's socket."""
        self.waiting.pop(server_conn.stream, None)
        super().on_close(server_conn)

    def let_go(self) -> None:
        """Close the connection that came first."""
        if self.waiting:
            first = next(iter(self.waiting))
            del self.waiting[first]
            first.close()

    def troubled(self, loop: AbstractEventLoop, context: dict[str, Any]) -> None:
        """Free a file descriptor if no connection can be accepted; asyncio prints a traceback each time."""
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in FULL:
            self.let_go()
        else:
            loop.default_exception_handler(context)


class Gate(AuthProvider):  # type: ignore[misc] # Bokeh's types are not checked
    """Admits clients with the token, and no page of another origin."""

    def __init__(self, address: str, token: str) -> None:
        self.address, self.token = address, token
        super().__init__()

    @property
    def get_user_async(self) -> Callable[[Any], Awaitable[str]]:
        """Bokeh calls this first on every request for the page, its data and its socket."""
        return self._user

    @property
    def login_url(self) -> str:
        """The redirect of Bokeh for clients without a user; they are refused instead."""
        return "/"

    async def _user(self, handler: Any) -> str:
        request, local = handler.request, f"http://{self.address}"
        if request.host != self.address or request.headers.get("Origin", local) != local:
            raise HTTPError(403, reason=f"This page is {local} and no other")
        every = handler.get_query_arguments(TOKEN)
        given = str(every[0]) if every else ""  # the model's own `token` comes after it
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            raise HTTPError(
                403, reason="The link that apc explore printed has the token that is missing here"
            )
        return "user"


def bound(make: Callable[[Document], None], port: int) -> tuple[BaseServer, str]:
    """Return a server that listens, and the link to it.

    Parameters
    ----------
    make
        Fills the document of a new tab.
    port
        The port; any free one if 0.

    Raises
    ------
    ApcError
        E982 the port is taken, or not ours to take.
    """
    try:
        sockets, port = bind_sockets(HOST, port)
    except OSError as error:
        why = {errno.EADDRINUSE: "is taken", errno.EACCES: "may not be taken by you"}
        message = f"port {port} {why.get(error.errno or 0, f'can not be used: {error.strerror}')}"
        raise ApcError(
            Diagnostic("E982", SourceLocation("--port"), message, hint="--port 0  (any that is free)")
        ) from None
    token, address = secrets.token_urlsafe(24), f"{HOST}:{port}"
    application = BokehTornado(
        {"/": Application(FunctionHandler(make))},
        absolute_url=f"http://{address}/",
        extra_websocket_origins=[address],
        auth_provider=Gate(address, token),
        sign_sessions=True,
        secret_key=secrets.token_bytes(32),
        check_unused_sessions_milliseconds=EVALUATED,
        unused_session_lifetime_milliseconds=CLOSED,
        include_headers=[],
        include_cookies=[],
    )
    http, loop = Door(application), IOLoop.current()
    http.add_sockets(sockets)
    loop.asyncio_loop.set_exception_handler(http.troubled)
    return BaseServer(loop, application, http), f"http://{address}/?{TOKEN}={token}"


def run(server: BaseServer, link: str, *, browser: bool) -> None:
    """Serve until Ctrl-C, or until somebody ends this process.

    Parameters
    ----------
    server, link
        As `bound` returns them.
    browser
        Whether to open the link.
    """
    # Refused clients get a reply; the terminal has no record of these or of closing tabs, and no token is
    # printed again.
    for name in ("tornado.access", "tornado.general", "bokeh.server.views.ws"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    logging.getLogger("bokeh.server.protocol_handler").addFilter(_shortened)
    for handler in logging.getLogger().handlers or filter(None, [logging.lastResort]):
        handler.addFilter(partial(_without_token, link.partition(f"{TOKEN}=")[2]))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # even where Ctrl-C is ignored
    server.start()
    try:
        with _open_page(server.io_loop, link) if browser else nullcontext():
            server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
        # At the exit of Python, workers of a tab would be destroyed in arbitrary order.
        for session in server.get_sessions():
            for close in session.document.session_destroyed_callbacks:
                close(session.document.session_context)


@contextmanager
def _open_page(loop: IOLoop, link: str) -> Iterator[None]:
    """Open a local file in the browser that redirects to the link: command lines are visible to all users."""
    import webbrowser

    with NamedTemporaryFile("w", prefix="apc-explore-", suffix=".html", encoding="utf-8") as file:
        file.write(LEADING.format(link=escape(link)))
        file.flush()
        loop.add_callback(webbrowser.open, Path(file.name).as_uri())
        yield


def _is_ours(reached: TracebackType | None) -> bool:
    """Return whether a traceback passes through this package."""
    return any(frame.f_globals["__name__"].startswith("apc.") for frame, _ in traceback.walk_tb(reached))


def _without_token(token: str, record: logging.LogRecord) -> bool:
    """Log a failed request in one line, without the token; a fault of ours keeps its traceback."""
    try:
        text = record.getMessage().partition("\n")[0]
    except (TypeError, ValueError):  # its arguments do not fit its text
        text = str(record.msg)
    _, error, reached = record.exc_info or (None, None, None)
    if error is not None and not _is_ours(reached):
        text, record.exc_info, record.exc_text = f"a request failed: {error!r:.200}", None, None
    record.msg, record.args = text.replace(token, "…"), ()
    return True


def _shortened(record: logging.LogRecord) -> bool:
    """Print one line if Bokeh refused a message of the page; internal errors keep their traceback."""
    _, error, reached = record.exc_info or (None, None, None)
    if not _is_ours(reached):
        record.msg, record.args = f"a message of the page was ignored: {error!r:.200}", ()
        record.exc_info = None
    return True
