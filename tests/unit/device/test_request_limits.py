from bricktrack_device.network.request_limits import MAX_REMEMBERED, BusyBudget, PeerRates


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_peer_may_burst_and_then_keeps_to_its_rate() -> None:
    clock = Clock()
    rates = PeerRates(per_second=10, burst=5, clock=clock)
    assert [rates.allows(b"a") for _ in range(7)] == [True] * 5 + [False] * 2
    assert rates.allows(b"b")  # others are not held back
    clock.now += 0.25  # two and a half requests
    assert [rates.allows(b"a") for _ in range(3)] == [True, True, False]
    clock.now += 60
    assert [rates.allows(b"a") for _ in range(6)] == [True] * 5 + [False]


def test_only_so_many_peers_are_remembered() -> None:
    rates = PeerRates(clock=Clock())
    for i in range(10 * MAX_REMEMBERED):
        rates.allows(i.to_bytes(4, "big"))
    assert len(rates._peers) == MAX_REMEMBERED


def test_a_busy_unit_serves_so_many_in_a_slot() -> None:
    clock = Clock()
    budget = BusyBudget(slot_s=0.1, n_requests=3, clock=clock)
    for _ in range(3):
        assert budget.wait_s() == 0.0
        budget.spend()
    clock.now += 0.04
    assert abs(budget.wait_s() - 0.06) < 1e-9
    clock.now += 0.06 + 1e-9
    assert budget.wait_s() == 0.0
