"""The page's door: what it takes to be served elsewhere, and who is let in."""

import asyncio
import base64

import pytest

from bricktrack_common.errors import ConfigError

pytest.importorskip("starlette", reason="the control page's libraries are not installed")

from bricktrack_host.dashboard import access
from bricktrack_host.dashboard.access import Door, check_access

PASSWORD = "correct horse"


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "::1", "127.3.2.1"])
def test_this_machine_alone_needs_nothing(host):
    check_access(host, password="", has_tls=False)


@pytest.mark.parametrize(
    ("password", "has_tls", "words"),
    [
        ("", False, "a password .* and TLS"),
        (PASSWORD, False, "give TLS"),
        ("", True, "give a password"),
        ("short", True, "5 characters; expected 10"),
    ],
)
@pytest.mark.parametrize("host", ["0.0.0.0", "::", "10.0.0.2", "lab-host"])
def test_elsewhere_needs_password_and_tls(host, password, has_tls, words):
    with pytest.raises(ConfigError, match=words):
        check_access(host, password=password, has_tls=has_tls)
    check_access(host, password=PASSWORD, has_tls=True)


def ask(door, kind="http", **headers):
    """Return the status that a request gets, and the headers of the answer; 101 for a web socket let in."""
    scope = {
        "type": kind,
        "headers": [(k.encode(), v.encode()) for k, v in {"host": "localhost:1", **headers}.items()],
    }
    sent = []

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    asyncio.run(door(scope, receive, send))
    first = sent[0]
    status = {"websocket.accept": 101, "websocket.close": 403}.get(first["type"], first.get("status"))
    return status, dict(first.get("headers", []))


async def inside(scope, receive, send):
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
    else:
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"in"})


def basic(password):
    return "Basic " + base64.b64encode(f"anyone:{password}".encode()).decode()


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_without_a_password_other_sites_stay_out(kind):
    door = Door(inside)
    good = 200 if kind == "http" else 101
    assert ask(door, kind)[0] == good
    assert ask(door, kind, origin="http://localhost:1")[0] == good
    assert ask(door, kind, origin="http://evil.example")[0] == 403
    assert ask(door, kind, host="evil.example:1")[0] == 403  # its name made to point here
    assert ask(door, kind, origin="null")[0] == 403


def test_with_a_password_it_is_asked_for_once(monkeypatch):
    monkeypatch.setattr(access, "_WRONG_DELAY_S", 0.0)
    door = Door(inside, password=PASSWORD, has_tls=True)
    status, headers = ask(door, host="lab-host:1")
    assert status == 401 and headers[b"www-authenticate"].startswith(b"Basic")
    for wrong in (basic("wrong horse"), basic(""), "Basic !!", "Bearer " + PASSWORD):
        assert ask(door, authorization=wrong)[0] == 401
    status, headers = ask(door, host="lab-host:1", authorization=basic(PASSWORD))
    cookie = headers[b"set-cookie"].decode()
    assert status == 200
    assert {"HttpOnly", "SameSite=Strict", "Secure"} <= set(cookie.split("; "))
    session = cookie.split(";")[0]
    assert ask(door, "websocket", host="lab-host:1", cookie=session)[0] == 101
    assert ask(door, "websocket", host="lab-host:1", cookie=session[:-1])[0] == 403
    assert ask(Door(inside, password=PASSWORD), cookie=session)[0] == 401  # after a restart
