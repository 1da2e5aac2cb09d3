"""The server of a page: on this machine only, for clients with the link's token.

Takes: a factory of documents, one per tab; a port.
Gives: `bound`, a server and its link; `run`.
Guarantees: it listens on the loopback interface. Requests without the token, or from a page of another
origin, are refused on every path. Only the program's scripts are served as files. Sessions of tabs are
separate. Idle connections do not block other connections. The token is not in the arguments of a process.
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
TOKEN = "token"  # the argument of the link with the token

# Interval of the check for closed tabs, and the time after which a tab is considered closed, in ms.
CHECK_INTERVAL, CLOSED_AFTER = 2_000, 10_000


# The largest number of connections that are not yet the socket of a tab: above it the oldest is closed. A
# browser opens six. The time in seconds within which a request must be complete.
MOST, REQUEST_TIMEOUT = 100, 10.0
FULL = (errno.EMFILE, errno.ENFILE)  # no file descriptor is available for a new connection

# The file opened in the browser, with the link readable by its owner only.
REDIRECT_PAGE = """<!DOCTYPE html><meta charset="utf-8"><title>apc explore</title>
<meta name="referrer" content="no-referrer"><meta http-equiv="refresh" content="0; url={link}">
<p><a href="{link}">The page of apc explore</a>
"""


class ConnectionServer(HTTPServer):  # type: ignore[misc] # Tornado's types are not checked
    """An HTTP server with a limited number of waiting connections: above the limit the oldest is closed."""

    def initialize(self, application: BokehTornado) -> None:
        """Initialize; Tornado calls this method as its constructor."""
        super().initialize(application, idle_connection_timeout=REQUEST_TIMEOUT, body_timeout=REQUEST_TIMEOUT)
        self.waiting: dict[Any, None] = {}

    def handle_stream(self, stream: Any, address: Any) -> None:
        """Accept a new connection."""
        if len(self.waiting) >= MOST:
            self.close_oldest()
        self.waiting[stream] = None
        super().handle_stream(stream, address)

    def on_close(self, server_conn: Any) -> None:
        """Remove a connection that was closed, or has become the socket of a tab."""
        self.waiting.pop(server_conn.stream, None)
        super().on_close(server_conn)

    def close_oldest(self) -> None:
        """Close the oldest waiting connection."""
        if self.waiting:
            first = next(iter(self.waiting))
            del self.waiting[first]
            first.close()

    def handle_error(self, loop: AbstractEventLoop, context: dict[str, Any]) -> None:
        """Close a connection if no file descriptor is available; pass other errors to asyncio.

        asyncio would print a traceback for each connection that cannot be accepted.
        """
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in FULL:
            self.close_oldest()
        else:
            loop.default_exception_handler(context)


class TokenAuthentication(AuthProvider):  # type: ignore[misc] # Bokeh's types are not checked
    """Authentication by the token of the link; requests from pages of another origin are refused."""

    def __init__(self, address: str, token: str) -> None:
        self.address, self.token = address, token
        super().__init__()

    @property
    def get_user_async(self) -> Callable[[Any], Awaitable[str]]:
        """The function that Bokeh calls first for every request for the page, its data and its socket."""
        return self._user

    @property
    def login_url(self) -> str:
        """The redirect of Bokeh for clients without a user; never used, as such clients are refused."""
        return "/"

    async def _user(self, handler: Any) -> str:
        """Return the user of a request with the token and the origin of this server.

        Raises HTTPError otherwise.
        """
        request, local = handler.request, f"http://{self.address}"
        if request.host != self.address or request.headers.get("Origin", local) != local:
            raise HTTPError(403, reason=f"This page is {local} and no other")
        tokens = handler.get_query_arguments(TOKEN)
        # Further values belong to a model parameter named `token`.
        sent_token = str(tokens[0]) if tokens else ""
        if not hmac.compare_digest(sent_token.encode(), self.token.encode()):
            raise HTTPError(
                403, reason="The link that apc explore printed has the token that is missing here"
            )
        return "user"


def bound(make: Callable[[Document], None], port: int) -> tuple[BaseServer, str]:
    """Return a server that listens on a port, and the link to its page.

    Parameters
    ----------
    make
        The function that fills the document of a new tab.
    port
        The port; any free one if 0.

    Raises
    ------
    ApcError
        E982 the port is in use, or not permitted.
    """
    try:
        sockets, port = bind_sockets(HOST, port)
    except OSError as error:
        why = {errno.EADDRINUSE: "is taken", errno.EACCES: "may not be taken by you"}
        message = f"port {port} {why.get(error.errno or 0, f'can not be used: {error.strerror}')}"
        raise ApcError(Diagnostic("E982", SourceLocation("--port"), message, fix="--port 0")) from None
    token, address = secrets.token_urlsafe(24), f"{HOST}:{port}"
    application = BokehTornado(
        {"/": Application(FunctionHandler(make))},
        absolute_url=f"http://{address}/",
        extra_websocket_origins=[address],
        auth_provider=TokenAuthentication(address, token),
        sign_sessions=True,
        secret_key=secrets.token_bytes(32),
        check_unused_sessions_milliseconds=CHECK_INTERVAL,
        unused_session_lifetime_milliseconds=CLOSED_AFTER,
        include_headers=[],
        include_cookies=[],
    )
    http, loop = ConnectionServer(application), IOLoop.current()
    http.add_sockets(sockets)
    loop.asyncio_loop.set_exception_handler(http.handle_error)
    return BaseServer(loop, application, http), f"http://{address}/?{TOKEN}={token}"


def run(server: BaseServer, link: str, *, browser: bool) -> None:
    """Serve the page until Ctrl-C or the termination of this process.

    Parameters
    ----------
    server, link
        As `bound` returns them.
    browser
        Whether to open the link.
    """
    # Refused clients get a reply. Refused requests and closed tabs are not logged, and the token is not
    # printed again.
    for name in ("tornado.access", "tornado.general", "bokeh.server.views.ws"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    logging.getLogger("bokeh.server.protocol_handler").addFilter(_shortened)
    for handler in logging.getLogger().handlers or filter(None, [logging.lastResort]):
        handler.addFilter(partial(_without_token, link.partition(f"{TOKEN}=")[2]))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # also if Ctrl-C is ignored
    server.start()
    try:
        with _open_page(server.io_loop, link) if browser else nullcontext():
            server.io_loop.start()
    except KeyboardInterrupt:
        pass
    finally:
        server.stop()
        # The workers of tabs are ended here: at the exit of Python they would be destroyed in arbitrary
        # order.
        for session in server.get_sessions():
            for close in session.document.session_destroyed_callbacks:
                close(session.document.session_context)


@contextmanager
def _open_page(loop: IOLoop, link: str) -> Iterator[None]:
    """Open the page in the browser by a local file that redirects to the link.

    A link on a command line would be visible to all users.
    """
    import webbrowser

    with NamedTemporaryFile("w", prefix="apc-explore-", suffix=".html", encoding="utf-8") as file:
        file.write(REDIRECT_PAGE.format(link=escape(link)))
        file.flush()
        loop.add_callback(webbrowser.open, Path(file.name).as_uri())
        yield


def _is_ours(trace: TracebackType | None) -> bool:
    """Return whether a traceback passes through this package."""
    return any(frame.f_globals["__name__"].startswith("apc.") for frame, _ in traceback.walk_tb(trace))


def _without_token(token: str, record: logging.LogRecord) -> bool:
    """Shorten the log record of a failed request to one line without the token.

    The result is always true, as this is a logging filter. Internal errors keep their traceback.
    """
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
    """Shorten the log record of a message of the page that Bokeh refused to one line.

    The result is always true, as this is a logging filter. Internal errors keep their traceback.
    """
    _, error, reached = record.exc_info or (None, None, None)
    if not _is_ours(reached):
        record.msg, record.args = f"a message of the page was ignored: {error!r:.200}", ()
        record.exc_info = None
    return True
