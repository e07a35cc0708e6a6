"""The control page's door in a real Chromium: password and TLS for others, and what is seen when the server goes."""

import contextlib
import os
import shutil
import signal
import subprocess
import sys

import pytest
from fake_unit import FakeUnit
from headless_chromium import headless_chromium, needs_chromium
from playwright.sync_api import Error, expect

pytest.importorskip("nicegui", reason="the control page's libraries are not installed")

PASSWORD = "correct horse battery"

pytestmark = [pytest.mark.slow, needs_chromium]


@pytest.fixture(scope="module")
def browser():
    with headless_chromium() as chromium:
        yield chromium


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """A fleet file, and the one unit that it names."""
    folder = tmp_path_factory.mktemp("lab")
    with FakeUnit(folder, name="a") as unit:
        file = folder / "fleet.toml"
        file.write_text(f'[[unit]]\nname = "a"\naddress = "{unit.address}"\n')
        yield file, unit


@contextlib.contextmanager
def served(fleet, *options, port=0, password=""):
    """Serve the page as people do; yield the process and the page's address."""
    command = [sys.executable, "-m", "bricktrack_host.cli", "dashboard", "--fleet", str(fleet)]
    environment = os.environ | {"BRICKTRACK_DASHBOARD_PASSWORD": password}
    process = subprocess.Popen(
        [*command, "--port", str(port), *map(str, options)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    try:
        line = process.stdout.readline()
        assert "http" in line, process.stderr.read()
        yield process, line.split()[-1]
    finally:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        process.communicate(timeout=30)


def state_of_a(page):
    return page.locator('.unit[data-unit="a"]')


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl to make a certificate with")
def test_others_need_the_password_and_speak_tls(browser, fleet, tmp_path):
    file, unit = fleet
    # The command of docs/how-to/dashboard.md, with a small key to save time.
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=lab-host",
         "-keyout", "page.key", "-out", "page.crt"],
        cwd=tmp_path, check=True, capture_output=True,
    )  # fmt: skip
    tls = ("--certificate", tmp_path / "page.crt", "--private-key", tmp_path / "page.key")
    with served(file, "--host", "0.0.0.0", *tls, password=PASSWORD) as (_, url):
        url = url.replace("0.0.0.0", "127.0.0.1")
        assert url.startswith("https://")

        context = browser.new_context()  # it was told nothing of this certificate
        with contextlib.closing(context), pytest.raises(Error, match="ERR_CERT_AUTHORITY_INVALID"):
            context.new_page().goto(url)

        with contextlib.closing(browser.new_context(ignore_https_errors=True)) as stranger:
            page = stranger.new_page()
            answer = page.request.get(url)
            assert answer.status == 401
            assert answer.headers["www-authenticate"].startswith("Basic")
            assert "unit" not in answer.text()
            assert page.request.get(f"{url}/_nicegui_ws/socket.io/?EIO=4&transport=polling").status == 401
            assert page.request.get(f"{url}/lab/fleet.toml").status == 401

        wrong = {"username": "anyone", "password": "wrong horse battery"}
        context = browser.new_context(ignore_https_errors=True, http_credentials=wrong)
        with contextlib.closing(context):
            with contextlib.suppress(Error):  # how Chromium puts that its credentials were not taken
                assert context.new_page().goto(url).status == 401
            assert not context.cookies()

        right = wrong | {"password": PASSWORD}
        context = browser.new_context(ignore_https_errors=True, http_credentials=right)
        with contextlib.closing(context):
            page = context.new_page()
            page.goto(url)
            expect(state_of_a(page)).to_have_attribute("data-state", "idle", timeout=30_000)
            unit.state = "armed"  # which comes over the web socket, that the session's cookie lets in
            expect(state_of_a(page)).to_have_attribute("data-state", "armed", timeout=30_000)
            unit.state = "idle"
            [cookie] = context.cookies()
            assert cookie["secure"] and cookie["httpOnly"] and cookie["sameSite"] == "Strict"


def test_this_machine_needs_no_password_and_a_silent_server_is_told(browser, fleet):
    with contextlib.closing(browser.new_context()) as context, contextlib.ExitStack() as opened:
        process, url = opened.enter_context(served(fleet[0]))
        page = context.new_page()
        page.goto(url)
        expect(page.locator(".ag-row").first).to_be_visible(timeout=30_000)
        banner = page.get_by_role("alert").filter(has_text="No word from the page's server since")
        expect(banner).to_be_hidden()

        process.send_signal(signal.SIGSTOP)  # as good as a cable that was pulled
        expect(banner).to_be_visible(timeout=15_000)
        assert page.evaluate("document.getElementById('app').inert"), "no order can be given"
        process.send_signal(signal.SIGCONT)
        expect(banner).to_be_hidden(timeout=30_000)
        expect(page.locator("#app[inert]")).to_have_count(0)

        opened.close()  # the server ends, and another one starts in its place
        expect(banner).to_be_visible(timeout=15_000)
        with served(fleet[0], port=int(url.rpartition(":")[2])):
            expect(banner).to_be_hidden(timeout=60_000)
            expect(state_of_a(page)).to_have_attribute("data-state", "idle", timeout=30_000)
