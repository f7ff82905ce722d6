"""A server that the page's library runs for this machine alone, and the gate through which others reach it.

Anybody who can reach the page can move what it shows. Beyond this machine a token is asked for: the address with
``?token=...`` sets a cookie, without it every connection is refused before it reaches the page's server.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import io
import ipaddress
import socket
import threading
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

import viser

from experiments.errors import ConfigError

LOCAL = "127.0.0.1"
COOKIE = "mjx_tt_view"
LONGEST_HEAD = 65536  # [bytes] of a request
CHUNK = 65536  # [bytes]


def is_local(host: str) -> bool:
    """True for an address that only this machine can reach."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


class Server(viser.ViserServer):
    """viser's server without its tunnel through the internet, which anybody at the page could open."""

    def __init__(self, host: str, port: int) -> None:
        check_free(host, port)
        with contextlib.redirect_stdout(io.StringIO()):  # the address is printed by the command
            super().__init__(host=host, port=port, label="mjx-tt view", verbose=False)

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


def allowed(request: bytes, token: str) -> tuple[bool, bool]:
    """Two answers to the head of a request: it may pass, having the cookie; it brings the token, to get the cookie."""
    lines = request.decode("latin-1").split("\r\n")
    parts = lines[0].split(" ")
    given = parse_qs(urlsplit(parts[1]).query).get("token", [""])[0] if len(parts) == 3 else ""
    cookies: SimpleCookie = SimpleCookie()
    for line in lines[1:]:
        name, _, value = line.partition(":")
        if name.strip().lower() == "cookie":
            with contextlib.suppress(CookieError):
                cookies.load(value.strip())
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
            if passes and not brings:
                inside = await asyncio.open_connection(LOCAL, self._behind)
                inside[1].write(head)
                await asyncio.gather(_pour(reader, inside[1]), _pour(inside[0], writer))
            elif brings:
                cookie = f"Set-Cookie: {COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/\r\n"
                writer.write(f"HTTP/1.1 303 See Other\r\nLocation: /\r\n{cookie}{_EMPTY}".encode())
            else:
                text = b"This page needs its token: open the address that mjx-tt view has printed.\n"
                kind = "Content-Type: text/plain; charset=utf-8\r\n"
                writer.write(f"HTTP/1.1 403 Forbidden\r\n{kind}Content-Length: {len(text)}\r\n{_CLOSE}".encode() + text)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # a client that says nothing, too much, or goes
        finally:
            writer.close()

    def stop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)


_CLOSE = "Connection: close\r\n\r\n"
_EMPTY = f"Content-Length: 0\r\n{_CLOSE}"


async def _pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass
    finally:
        writer.close()
