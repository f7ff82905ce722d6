"""Admission to the page over real sockets: the token, pages that are refused, and what the command refuses."""

import contextlib
import http.client
import socket

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from experiments import cli
from experiments.errors import ConfigError
from experiments.runs.locate import SHIPPED
from experiments.view import auth

TOKEN = "a-token-of-its-own"
COOKIE = {"Cookie": f"{auth.COOKIE}={TOKEN}"}


@pytest.fixture(scope="module")
def ports():
    """Ports of a page for this machine and of one that needs a token."""
    servers = [auth.Server("127.0.0.1", 0), auth.Server("127.0.0.1", 0, TOKEN)]
    yield [server.get_port() for server in servers]
    for server in servers:
        server.stop()


@pytest.fixture
def shared(ports):
    return ports[1]


def get(port, path="/", **headers) -> tuple[int, bytes, dict]:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.headers)


def answers(port: int, origin: str | None, **headers: str) -> bool:
    """True where the page's websocket speaks to a page of that origin, False where it refuses the connection."""
    version = [f"viser-v{viser.__version__}"]
    try:
        address = f"ws://127.0.0.1:{port}/"
        with connect(address, origin=origin, subprotocols=version, additional_headers=headers) as page:
            return len(page.recv(5)) > 0
    except InvalidStatus as refused:
        assert refused.response.status_code == 403
        return False


def test_without_the_token_everything_is_refused(shared):
    for path, headers in (
        ("/", {}),
        ("/?token=", {}),
        ("/?token=another-token", {}),
        ("/", {"Cookie": f"{auth.COOKIE}=another-token"}),
        ("/", {"Cookie": f"other={TOKEN}"}),
        ("/", {"Upgrade": "websocket", "Connection": "Upgrade"}),
    ):
        status, text, _ = get(shared, path, **headers)
        assert status in (400, 403) and b"<html" not in text, (path, headers)
    assert b"needs its token" in get(shared)[1]
    assert not answers(shared, None)


def test_the_token_gets_a_cookie_and_the_cookie_the_page(shared):
    status, _, headers = get(shared, f"/?token={TOKEN}")
    assert status == 303 and headers["Location"] == "/"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
    status, text, _ = get(shared, "/", Cookie=headers["Set-Cookie"].split(";")[0])
    assert status == 200 and b"<html" in text


def test_silent_and_endless_requests_do_not_disturb_others(shared):
    with (
        socket.create_connection(("127.0.0.1", shared)) as silent,
        socket.create_connection(("127.0.0.1", shared)) as endless,
    ):
        silent.sendall(b"GET / HTTP/1.1\r\n")
        endless.sendall(b"x" * 200_000)
        assert get(shared, "/", **COOKIE)[0] == 200


# Which of the two answer a page of this origin; behind the token only pages of the address that was asked for.
ORIGINS = {
    None: (True, True),  # a program
    "http://127.0.0.1:{port}": (True, True),
    "http://localhost:{port}": (True, False),
    "http://[::1]:{port}": (True, False),
    "http://example.org": (False, False),
    "http://example.org:{port}": (False, False),  # a name that its owner points to this machine
    "http://localhost.example.org:{port}": (False, False),
    "http://127.0.0.1:1": (False, False),  # another program of this machine
    "http://localhost": (False, False),
    "http://[::1:{port}": (False, False),
    "http://localhost:{port}x": (False, False),
    "null": (False, False),  # a file, or a frame without rights
}


@pytest.mark.parametrize("origin", ORIGINS)
def test_pages_of_this_machine_or_of_the_address_that_was_asked_for_are_answered_and_no_others(ports, origin):
    for port, headers, expected in zip(ports, ({}, COOKIE), ORIGINS[origin], strict=True):
        assert answers(port, origin and origin.format(port=port), **headers) == expected


def test_a_forwarded_port_is_a_page_of_this_machine_too():
    """``ssh -L 9000:127.0.0.1:8080``: the browser knows 9000 only."""
    assert auth.is_own_page("http://localhost:9000", "localhost:9000", 8080)
    assert not auth.is_own_page("http://localhost:9000", "localhost:8080", 8080)
    assert not auth.is_own_page("http://example.org:9000", "example.org:9000", 8080)


@pytest.mark.parametrize(
    ("host", "is_local"),
    [("127.0.0.1", True), ("127.1.2.3", True), ("::1", True), ("localhost", True)]
    + [("0.0.0.0", False), ("::", False), ("192.168.1.2", False), ("example.org", False)],
)
def test_only_this_machine_needs_no_token(host, is_local):
    assert auth.is_local(host) == is_local


def test_a_viser_that_starts_its_server_in_another_way_is_refused_and_its_tunnel_stays_shut(monkeypatch):
    monkeypatch.setattr(auth, "_checked_requests", lambda token: contextlib.nullcontext([1]))
    server = auth.Server("127.0.0.1", 0)
    assert server.request_share_url() is None
    server.stop()
    monkeypatch.setattr(auth, "_checked_requests", lambda token: contextlib.nullcontext([]))
    with pytest.raises(ConfigError, match="cannot be guarded"):
        auth.Server("127.0.0.1", 0)


def test_what_cannot_be_shown_is_refused_before_anything_heavy(tmp_path, capsys):
    policy = str(SHIPPED / "quickstart")
    for arguments, words in (
        (["nowhere"], "neither a run"),
        ([policy] * 5, "4 are the most"),
        (["--follow"], "--follow needs one run"),
        ([policy, "--follow"], "--follow needs one run"),  # an artefact is trained no further
        (["--token", "a b"], "at least 8 letters"),
        (["--export", "page.pdf"], "allowed: .html"),
        (["--model", str(tmp_path / "none.yaml")], "no such file"),
    ):
        assert cli.main(["view", *arguments]) in (1, 2)
        assert words in capsys.readouterr().err
