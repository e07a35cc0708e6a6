"""Messages are decoded by many threads from the first one on, as a host does that asks hundreds of units."""

import subprocess
import sys

FIRST_MESSAGES_AT_ONCE = """
import sys, threading
sys.setswitchinterval(1e-6)
from bricktrack_common.wire_codec import decode_request, encode_message
from bricktrack_common.wire_messages import Hello
message, together = encode_message(1, Hello(software="x")), threading.Barrier(100)
def decode():
    together.wait()
    decode_request(message)
threads = [threading.Thread(target=decode) for _ in range(100)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""


def test_the_first_messages_may_come_to_many_threads_at_once():
    # Types that are prepared only here crash about one process in three.
    started = [subprocess.Popen([sys.executable, "-c", FIRST_MESSAGES_AT_ONCE]) for _ in range(8)]
    assert [process.wait(timeout=60) for process in started] == [0] * 8
