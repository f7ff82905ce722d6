"""A server that the page's library runs for this machine alone, and the gate through which others reach it.

Anybody who can reach the page can move what it shows. Beyond this machine a token is asked for: the address with
``?token=...`` sets a cookie, without it every connection is refused before it reaches the page's server. A browser says
which page a connection comes from (header Origin, RFC 6454), and websockets of other pages, which no browser keeps
from this machine's ports, are refused. Programs that are no browsers send none.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import io
import ipaddress
import socket
import threading
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
LONGEST_HEAD = 65536  # [bytes] of a request
CHUNK = 65536  # [bytes]
FOREIGN = "This page answers to itself only: open the address that mjx-tt view has printed.\n"


def is_local(host: str) -> bool:
    """True for an address that only this machine can reach."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def is_own(origin: str, asked: str, port: int) -> bool:
    """True for a page of this machine at the port that listens, or at the one that is forwarded to it.

    origin, asked: headers Origin and Host. A name that somebody else has pointed to this machine is no name of it.
    """
    with contextlib.suppress(ValueError):
        page = urlsplit(origin)
        return is_local(page.hostname or "") and page.port in (port, urlsplit(f"//{asked}").port)
    return False


class Server(viser.ViserServer):
    """viser's server for its own pages, without its tunnel through the internet, which anybody there could open.

    Raises ConfigError for a port that is taken, and for a viser that starts its server in an unknown way.
    """

    def __init__(self, host: str, port: int) -> None:
        check_free(host, port)
        with contextlib.redirect_stdout(io.StringIO()), _guarded() as started:  # the address is printed by the command
            super().__init__(host=host, port=port, label="mjx-tt view", verbose=False)
        if not started:
            self.stop()
            raise ConfigError(f"viser {viser.__version__}: its server cannot be guarded; pip install 'viser==1.1.1'")

    def stop(self) -> None:
        with contextlib.redirect_stdout(io.StringIO()):
            super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


@contextlib.contextmanager
def _guarded() -> Iterator[list[int]]:
    """Makes the websocket server that viser starts meanwhile refuse other pages; yields the ports asked for.

    websockets calls ``process_request`` before it accepts a connection; viser has one, and no way to add another.
    """
    library: Any = websockets.asyncio.server
    serve, started = library.serve, []

    def guarded(handler: Any, host: str, port: int, *, process_request: Callable, **options: Any) -> Any:
        def admit(connection: ServerConnection, request: Request) -> Response | None:
            asked, mine = "".join(request.headers.get_all("Host")), connection.local_address[1]
            if all(is_own(origin, asked, mine) for origin in request.headers.get_all("Origin")):
                return process_request(connection, request)
            return connection.respond(HTTPStatus.FORBIDDEN, FOREIGN)

        started.append(port)
        return serve(handler, host, port, process_request=admit, **options)

    library.serve = guarded
    try:
        yield started
    finally:
        library.serve = serve


def check_free(host: str, port: int) -> None:
    """Raises ConfigError where nothing can listen there."""
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ConfigError(f"--host {host} --port {port}: {error.strerror or error}; choose another --port") from None


def fields(request: bytes, name: str) -> list[str]:
    """Values of a header in the head of a request."""
    pairs = (line.partition(":") for line in request.decode("latin-1").split("\r\n")[1:])
    return [value.strip() for key, _, value in pairs if key.strip().lower() == name]


def without_origin(request: bytes) -> bytes | None:
    """The head of a request as the page's server is to see it; None where it comes from a page at another address."""
    asked = [f"{scheme}://{host}" for host in fields(request, "host") for scheme in ("http", "https")]
    if any(origin not in asked for origin in fields(request, "origin")):
        return None
    return b"\r\n".join(line for line in request.split(b"\r\n") if line[:7].lower() != b"origin:")


def allowed(request: bytes, token: str) -> tuple[bool, bool]:
    """Two answers to the head of a request: it may pass, having the cookie; it brings the token, to get the cookie."""
    parts = request.decode("latin-1").split("\r\n")[0].split(" ")
    given = parse_qs(urlsplit(parts[1]).query).get("token", [""])[0] if len(parts) == 3 else ""
    cookies: SimpleCookie = SimpleCookie()
    for value in fields(request, "cookie"):
        with contextlib.suppress(CookieError):
            cookies.load(value)
    kept = cookies[COOKIE].value if COOKIE in cookies else ""
    return hmac.compare_digest(kept.encode(), token.encode()), hmac.compare_digest(given.encode(), token.encode())


class Gate:
    """Listens at an address and passes connections that have the token on to a local port."""

    def __init__(self, host: str, port: int, token: str, behind: int) -> None:
        check_free(host, port)
        self._token, self._behind = token, behind
        self._loop = asyncio.new_event_loop()
        self._server = self._loop.run_until_complete(asyncio.start_server(self._accept, host, port))
        self.port = self._server.sockets[0].getsockname()[1]
        threading.Thread(target=self._loop.run_forever, daemon=True).start()

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 10.0)
            passes, brings = allowed(head, self._token)
            inner = without_origin(head)
            if inner is None:
                writer.write(_refusal(FOREIGN))
            elif passes and not brings:
                inside = await asyncio.open_connection(LOCAL, self._behind)
                inside[1].write(inner)
                await asyncio.gather(_pour(reader, inside[1]), _pour(inside[0], writer))
            elif brings:
                cookie = f"Set-Cookie: {COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/\r\n"
                writer.write(f"HTTP/1.1 303 See Other\r\nLocation: /\r\n{cookie}{_EMPTY}".encode())
            else:
                writer.write(_refusal("This page needs its token: open the address that mjx-tt view has printed.\n"))
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a client that says nothing, too much, or goes
        finally:
            writer.close()

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)


_CLOSE = "Connection: close\r\n\r\n"
_EMPTY = f"Content-Length: 0\r\n{_CLOSE}"


def _refusal(text: str) -> bytes:
    kind = "Content-Type: text/plain; charset=utf-8\r\n"
    return f"HTTP/1.1 403 Forbidden\r\n{kind}Content-Length: {len(text)}\r\n{_CLOSE}{text}".encode()


async def _pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass
    finally:
        writer.close()
