"""Admission to the page: the token's rule over real sockets, and what the command refuses."""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from experiments import cli
from experiments.commands import render
from experiments.errors import ConfigError
from experiments.view import guard

TOKEN = "a-token-of-its-own"


class Page(BaseHTTPRequestHandler):
    """The server behind the gate."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"the page")

    def log_message(self, *arguments) -> None:
        pass


@pytest.fixture
def gate():
    behind = HTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=behind.serve_forever, daemon=True).start()
    gate = guard.Gate("127.0.0.1", 0, TOKEN, behind.server_port)
    yield gate
    gate.stop()
    behind.shutdown()


def get(gate, path="/", **headers) -> tuple[int, bytes, dict]:
    connection = http.client.HTTPConnection("127.0.0.1", gate.port, timeout=5)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    return answer.status, answer.read(), dict(answer.headers)


def test_without_the_token_everything_is_refused(gate):
    for path, headers in (
        ("/", {}),
        ("/?token=", {}),
        ("/?token=another-token", {}),
        ("/", {"Cookie": f"{guard.COOKIE}=another-token"}),
        ("/", {"Cookie": f"other={TOKEN}"}),
        ("/", {"Upgrade": "websocket", "Connection": "Upgrade"}),
    ):
        status, text, _ = get(gate, path, **headers)
        assert status == 403 and b"token" in text and b"the page" not in text


def test_the_token_gets_a_cookie_and_the_cookie_the_page(gate):
    status, _, headers = get(gate, f"/?token={TOKEN}")
    assert status == 303 and headers["Location"] == "/"
    assert "HttpOnly" in headers["Set-Cookie"] and "SameSite=Strict" in headers["Set-Cookie"]
    status, text, _ = get(gate, "/", Cookie=headers["Set-Cookie"].split(";")[0])
    assert (status, text) == (200, b"the page")


def test_silent_and_endless_requests_do_not_disturb_others(gate):
    with (
        socket.create_connection(("127.0.0.1", gate.port)) as silent,
        socket.create_connection(("127.0.0.1", gate.port)) as endless,
    ):
        silent.sendall(b"GET / HTTP/1.1\r\n")
        endless.sendall(b"x" * 200_000)
        assert get(gate, "/", Cookie=f"{guard.COOKIE}={TOKEN}")[0] == 200


@pytest.mark.parametrize(
    ("host", "local"),
    [("127.0.0.1", True), ("127.1.2.3", True), ("::1", True), ("localhost", True)]
    + [("0.0.0.0", False), ("::", False), ("192.168.1.2", False), ("example.org", False)],
)
def test_only_this_machine_needs_no_token(host, local):
    assert guard.is_local(host) == local


def test_a_port_that_is_taken_is_named():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"--port {port}: .*choose another --port"):
            guard.check_free("127.0.0.1", port)


@pytest.fixture(scope="module")
def server():
    server = guard.Server("127.0.0.1", 0)
    yield server
    server.stop()


def test_the_tunnel_of_the_pages_library_stays_shut(server):
    assert server.request_share_url() is None


def answers(port: int, origin: str | None, **headers: str) -> bool:
    """True where the page's websocket speaks to a page of that origin, False where it refuses the connection."""
    version = [f"viser-v{viser.__version__}"]
    try:
        address = f"ws://127.0.0.1:{port}/"
        with connect(address, origin=origin, subprotocols=version, additional_headers=headers) as page:
            return len(page.recv(5)) > 0
    except InvalidStatus as refused:
        assert refused.response.status_code == 403 and b"answers to itself only" in refused.response.body
        return False


def test_a_websocket_answers_pages_of_this_machine_at_its_port_and_programs_without_a_page(server):
    port = server.get_port()
    for name in ("127.0.0.1", "localhost", "[::1]"):
        assert answers(port, f"http://{name}:{port}")
    assert answers(port, None)


def test_a_websocket_refuses_pages_of_others(server):
    port = server.get_port()
    for origin in (
        "http://example.org",
        f"http://example.org:{port}",  # a name that its owner points to this machine: Host would be the same
        f"http://localhost.example.org:{port}",
        f"http://127.0.0.1:{port + 1}",  # another program of this machine
        "http://localhost",
        f"http://[::1:{port}",
        f"http://localhost:{port}x",
        "null",  # a file, or a frame without rights
    ):
        assert not answers(port, origin), origin


def test_a_forwarded_port_is_a_page_of_this_machine_too():
    """``ssh -L 9000:127.0.0.1:8080``: the browser knows 9000 only."""
    assert guard.is_own("http://localhost:9000", "localhost:9000", 8080)
    assert not guard.is_own("http://localhost:9000", "localhost:8080", 8080)
    assert not guard.is_own("http://example.org:9000", "example.org:9000", 8080)


def test_the_gate_answers_pages_of_the_address_that_was_asked_for(server):
    gate = guard.Gate("127.0.0.1", 0, TOKEN, server.get_port())
    cookie = {"Cookie": f"{guard.COOKIE}={TOKEN}"}
    try:
        assert answers(gate.port, f"http://127.0.0.1:{gate.port}", **cookie)
        assert answers(gate.port, None, **cookie)
        for origin in ("http://example.org", f"http://127.0.0.1:{gate.port + 1}", f"http://localhost:{gate.port}"):
            assert not answers(gate.port, origin, **cookie)
    finally:
        gate.stop()


def test_a_page_library_that_starts_its_server_in_another_way_is_refused(monkeypatch):
    monkeypatch.setattr(guard, "_guarded", lambda: contextlib.nullcontext([]))
    with pytest.raises(ConfigError, match="cannot be guarded"):
        guard.Server("127.0.0.1", 0)


def test_what_cannot_be_shown_is_refused_before_anything_heavy(tmp_path, capsys, monkeypatch):
    policy = str(render.SHIPPED)
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
    monkeypatch.setattr(render, "find_spec", lambda name: None if name == "viser" else object())
    assert cli.main(["view"]) == 1
    assert capsys.readouterr().err == "mjx-tt: error: view needs viser: pip install 'mjx-tt[view]'\n"
