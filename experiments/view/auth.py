"""viser's server behind a check of who asks: pages of this machine, or browsers that have the token.

Whoever reaches the page can move what it shows. On an address that others reach a token is needed: ``/?token=...`` sets
a cookie, and without it every request is refused before viser sees it. A browser says which page a connection comes
from (header Origin, RFC 6454); connections of other pages, which no browser keeps from this machine's ports, are
refused. Programs that are no browsers send no Origin.
"""

from __future__ import annotations

import contextlib
import hmac
import io
import ipaddress
import socket
from collections.abc import Callable, Iterator
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from experiments.errors import ConfigError

LOCAL = "127.0.0.1"
COOKIE = "mjx_tt_view"
FOREIGN = "This page answers to itself only: open the address that mjx-tt view has printed.\n"
NO_TOKEN = "This page needs its token: open the address that mjx-tt view has printed.\n"


def is_local(host: str) -> bool:
    """True for an address that only this machine can reach."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def is_own_page(origin: str, host: str, port: int) -> bool:
    """True for a page of this machine at the port that listens, or at the one that is forwarded to it.

    origin, host: the headers. A foreign name that points to this machine is not one of its own.
    """
    with contextlib.suppress(ValueError):
        page = urlsplit(origin)
        return is_local(page.hostname or "") and page.port in (port, urlsplit(f"//{host}").port)
    return False


class Server(viser.ViserServer):
    """viser's server without its tunnel through the internet; with a token, others than this machine need it.

    Raises ConfigError for a port that is taken, and for a viser that starts its server in an unknown way.
    """

    def __init__(self, host: str, port: int, token: str | None = None) -> None:
        check_free(host, port)
        with contextlib.redirect_stdout(io.StringIO()), _checked_requests(token) as started:  # the command prints
            super().__init__(host=host, port=port, label="mjx-tt view", verbose=False)
        if not started:
            self.stop()
            raise ConfigError(f"viser {viser.__version__}: its server cannot be guarded; pip install 'viser==1.1.1'")

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def check_free(host: str, port: int) -> None:
    """Raises ConfigError where nothing can listen there."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ConfigError(f"--host {host} --port {port}: {error.strerror or error}; choose another --port") from None


@contextlib.contextmanager
def _checked_requests(token: str | None) -> Iterator[list[int]]:
    """Makes the server that viser starts meanwhile check every request; yields the ports asked for.

    websockets calls ``process_request`` before it answers or upgrades a connection; viser has one of its own, and no
    way to add another.
    """
    library: Any = websockets.asyncio.server
    serve, started = library.serve, []

    def serve_checked(handler: Any, host: str, port: int, *, process_request: Callable, **options: Any) -> Any:
        def process(connection: ServerConnection, request: Request) -> Response | None:
            refused = _refuse(connection, request, token)
            return process_request(connection, request) if refused is None else refused

        started.append(port)
        return serve(handler, host, port, process_request=process, **options)

    library.serve = serve_checked
    try:
        yield started
    finally:
        library.serve = serve


def _refuse(connection: ServerConnection, request: Request, token: str | None) -> Response | None:
    """The answer to a request that viser is not to see; None for others."""
    hosts, origins = (request.headers.get_all(name) for name in ("Host", "Origin"))
    if token is None:
        port = connection.local_address[1]
        trusted = all(is_own_page(origin, "".join(hosts), port) for origin in origins)
    else:
        trusted = set(origins) <= {f"{scheme}://{host}" for host in hosts for scheme in ("http", "https")}
    if not trusted:
        return connection.respond(HTTPStatus.FORBIDDEN, FOREIGN)
    if token is None:
        return None
    given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
    if hmac.compare_digest(given.encode(), token.encode()):
        response = connection.respond(HTTPStatus.SEE_OTHER, "")
        response.headers["Location"] = "/"
        response.headers["Set-Cookie"] = f"{COOKIE}={token}; HttpOnly; SameSite=Strict; Path=/"
        return response
    cookies: SimpleCookie = SimpleCookie()
    for value in request.headers.get_all("Cookie"):
        with contextlib.suppress(CookieError):
            cookies.load(value)
    kept = cookies[COOKIE].value if COOKIE in cookies else ""
    if hmac.compare_digest(kept.encode(), token.encode()):
        return None
    return connection.respond(HTTPStatus.FORBIDDEN, NO_TOKEN)
