"""Types are read by many threads from the first time on, as on a host that asks or pulls from hundreds of units."""

import subprocess
import sys

import pytest

AT_ONCE = """
import sys, threading
sys.setswitchinterval(1e-6)
{prepare}
together = threading.Barrier(100)
def read():
    together.wait()
    {read}
threads = [threading.Thread(target=read) for _ in range(100)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""
MESSAGE = """
from bricktrack_common.wire_codec import decode_request, encode_message
from bricktrack_common.wire_messages import Hello
message = encode_message(1, Hello(software="x"))
"""
MANIFEST = """
from bricktrack_common.run_manifest import parse_manifest
from bricktrack_common.typed_data import dump_json
text = dump_json(dict(
    schema="bricktrack.run", version=2, run_id="r", unit="u", label="", state="complete", simulated=True,
    origin="import", hardware={}, software={}, camera=None, imus=[], trigger=dict(pin="GPIO17", t0_ns=None),
    clocks={}, window_ns=None, quality={}, missing=[], files=[],
))
"""


@pytest.mark.parametrize(
    ("prepare", "read"),
    [(MESSAGE, "decode_request(message)"), (MANIFEST, 'parse_manifest(text, where="test")')],
)
def test_the_first_ones_may_come_to_many_threads_at_once(prepare: str, read: str) -> None:
    # Types that are prepared only here crash about one process in three.
    program = AT_ONCE.format(prepare=prepare, read=read)
    started = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(8)]
    assert [process.wait(timeout=60) for process in started] == [0] * 8
