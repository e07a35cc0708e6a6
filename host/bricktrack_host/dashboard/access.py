"""Who may open the page: on this machine only, or with a password over TLS."""

import asyncio
import base64
import binascii
import hmac
import secrets
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from bricktrack_common.errors import ConfigError
from bricktrack_host.transfer.fleet_config import is_loopback

MIN_PASSWORD_LENGTH = 10
_COOKIE = "bricktrack_session"
_WRONG_DELAY_S = 1.0
_LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")


def check_access(host: str, *, password: str, has_tls: bool) -> None:
    """Make sure that a page which others can reach has a password and TLS.

    Raises
    ------
    ConfigError
        If it lacks one of them, or the password is short.
    """
    if password and len(password) < MIN_PASSWORD_LENGTH:
        raise ConfigError(
            f"the password has {len(password)} characters; expected {MIN_PASSWORD_LENGTH} or more"
        )
    if is_local(host):
        return
    lacking = [words for given, words in (
        (password, "a password (BRICKTRACK_DASHBOARD_PASSWORD or --password-file)"),
        (has_tls, "TLS (--certificate and --private-key)"),
    ) if not given]  # fmt: skip
    if lacking:
        raise ConfigError(
            f"--host {host}: others can reach the page and command the units; give {' and '.join(lacking)}, "
            "or leave --host away to serve this machine alone"
        )


def is_local(host: str) -> bool:
    """Tell whether an address to bind to is this machine's own."""
    return is_loopback(f"tcp://[{host}]" if ":" in host else f"tcp://{host}")


class Door:
    """Lets in who may come in; wraps the whole application, its web sockets included.

    A page on another site must not command units through the browser of someone who may: the host asked for
    must be this machine's own, unless there is a password, and a request's origin must be the host asked for.
    With a password the browser asks for it once (HTTP Basic, any user name) and gets a session cookie.
    """

    def __init__(self, app: ASGIApp, *, password: str = "", has_tls: bool = False) -> None:
        self._app = app
        self._password = password
        self._secure = "; Secure" if has_tls else ""
        self._session = secrets.token_urlsafe(32)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}
        if not self._is_own_page(headers):
            await _refuse(scope, receive, send, 403, b"This page is not for other sites.\n")
            return
        if not self._password or self._has_session(headers):
            await self._app(scope, receive, send)
            return
        if not self._knows_password(headers):
            if "authorization" in headers:
                await asyncio.sleep(_WRONG_DELAY_S)
            await _refuse(scope, receive, send, 401, b"The page's password, please.\n")
            return
        cookie = f"{_COOKIE}={self._session}; Path=/; HttpOnly; SameSite=Strict{self._secure}"

        async def send_with_cookie(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.accept"):
                message["headers"] = [*message.get("headers", []), (b"set-cookie", cookie.encode("ascii"))]
            await send(message)

        await self._app(scope, receive, send_with_cookie)

    def _is_own_page(self, headers: dict[str, str]) -> bool:
        host = headers.get("host", "")
        try:
            if not self._password and urlsplit(f"//{host}").hostname not in _LOCAL_NAMES:
                return False
            origin = headers.get("origin", "")
            return not origin or urlsplit(origin).netloc == host
        except ValueError:
            return False

    def _has_session(self, headers: dict[str, str]) -> bool:
        try:
            given = SimpleCookie(headers.get("cookie", "")).get(_COOKIE)
        except CookieError:
            return False
        return given is not None and hmac.compare_digest(given.value.encode(), self._session.encode())

    def _knows_password(self, headers: dict[str, str]) -> bool:
        kind, _, value = headers.get("authorization", "").partition(" ")
        if kind.lower() != "basic":
            return False
        try:
            given = base64.b64decode(value, validate=True).partition(b":")[2]
        except binascii.Error:
            return False
        return hmac.compare_digest(given, self._password.encode())


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, words: bytes) -> None:
    if scope["type"] == "websocket":
        await receive()  # the connect; closing before accepting answers it with 403
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    if status == 401:
        headers.append((b"www-authenticate", b'Basic realm="bricktrack", charset="UTF-8"'))
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": words})
