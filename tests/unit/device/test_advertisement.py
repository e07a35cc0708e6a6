import socket
import sys
import time

import pytest

from bricktrack_common.discovery import SERVICE_TYPE, Announcement, parse_announcement
from bricktrack_device.network import advertisement as module
from bricktrack_device.network.advertisement import Advertisement

zeroconf = pytest.importorskip("zeroconf")


def own_address() -> str:
    addresses = module._own_addresses()
    if not addresses:
        pytest.skip("this machine has no network but loopback")
    return addresses[0]


def test_a_unit_is_found_by_its_announcement_and_not_after_it_stopped() -> None:
    address = own_address()
    ours = Announcement("adv-test-1", key_fingerprint="ebb3-af4d-d99c-eff3")
    advertisement = Advertisement(ours, address, 41799)
    advertisement.start()
    if advertisement._zeroconf is None:
        pytest.skip("multicast is not permitted here")
    listener = zeroconf.Zeroconf(interfaces=[address])
    try:
        info = listener.get_service_info(SERVICE_TYPE, ours.service_name, timeout=3000)
        assert info is not None and info.port == 41799 and address in info.parsed_addresses()
        assert parse_announcement(info.properties) == ours
        advertisement.stop()
        advertisement.stop()
        listener.cache.async_remove_records(list(listener.cache.entries_with_name(ours.service_name)))
        assert listener.get_service_info(SERVICE_TYPE, ours.service_name, timeout=300) is None
    finally:
        advertisement.stop()
        listener.close()


def test_loopback_is_announced_to_nobody() -> None:
    advertisement = Advertisement(Announcement("u"), "127.0.0.1", 1)
    advertisement.start()
    assert advertisement._zeroconf is None


def test_a_unit_without_zeroconf_works_all_the_same(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    monkeypatch.setitem(sys.modules, "zeroconf", None)
    Advertisement(Announcement("u"), "0.0.0.0", 1).start()
    assert "zeroconf is not installed" in caplog.text


def test_a_network_that_refuses_is_only_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(**_: object) -> None:
        raise OSError(19, "No such device")

    monkeypatch.setattr(zeroconf, "Zeroconf", refuse)
    started = time.monotonic()
    Advertisement(Announcement("u"), "0.0.0.0", 1).start()
    assert "not announced in the network: OSError" in caplog.text and time.monotonic() - started < 5
    assert socket.gethostname()


@pytest.mark.parametrize(
    "txt",
    [
        {},
        {b"unit": None, b"protocol": b"2.0"},
        {b"unit": b"b1"},
        {b"unit": b"b1", b"protocol": b"2"},
        {b"unit": b"b1", b"protocol": b"-2.0"},
        {b"unit": b"b1", b"protocol": b"99999.0"},
        {b"unit": b"a/b", b"protocol": b"2.0"},
        {b"unit": b"b\xff", b"protocol": b"2.0"},
        {b"unit": b"b1", b"protocol": b"2.0", b"key": b"xyz"},
        {b"unit": b"b1", b"protocol": b"2.0", b"key": b"a" * 65},
    ],
)
def test_an_announcement_that_is_none_of_ours_is_left_aside(txt: dict[bytes, bytes | None]) -> None:
    assert parse_announcement(txt) is None
