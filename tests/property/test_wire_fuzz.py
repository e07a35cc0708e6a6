"""The short form of ``scripts/fuzz_wire.py``."""

import random

from wire_fuzz import REPLIES, REQUESTS, Tally, messages, try_client, try_decoders, try_server, try_texts

from bricktrack_common import wire_messages


def test_the_decoders_return_a_checked_value_or_refuse():
    rng, tally = random.Random(7), Tally()
    source = messages(rng)
    for _ in range(10_000):
        try_decoders(next(source), tally)
        try_texts(rng, tally)
    # Both ways are walked often: a fuzzer whose messages are all refused at the door tries nothing.
    assert tally.accepted > 500 and tally.refused > 10_000


def test_the_server_answers_every_message_once_and_lives():
    tally = Tally()
    try_server(random.Random(8), 2000, tally)
    assert tally.cases == 2000 and tally.accepted > 20


def test_the_client_finds_its_answer_among_what_is_none():
    tally = Tally()
    try_client(random.Random(9), 2000, tally)
    assert tally.cases == 2000 and tally.accepted > 20


def test_every_message_is_among_the_seeds():
    assert {type(r) for r in REQUESTS} == set(wire_messages.Request.__args__)
    assert {type(r) for r in REPLIES} == set(wire_messages.Reply.__args__)
