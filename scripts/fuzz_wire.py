"""Fuzzes the wire protocol's decoders, the real server and the real client, for as long as wanted.

Usage: python scripts/fuzz_wire.py [--cases 1000000] [--seed 1]

Messages are right ones, changed ones, cut ones and noise; anything but a checked value or a refusal in words ends
the script with its traceback and the seed. One case in twenty goes over real sockets.
"""

import argparse
import random
import sys
import time
from pathlib import Path

from rich.progress import Progress

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from wire_fuzz import Tally, messages, try_client, try_decoders, try_server, try_texts

BLOCK = 4000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = random.Random(arguments.seed)
    source, tally, started = messages(rng), Tally(), time.monotonic()
    with Progress() as bar:
        task = bar.add_task(f"seed {arguments.seed}", total=arguments.cases)
        while tally.cases < arguments.cases:
            for _ in range(BLOCK // 2):
                try_decoders(next(source), tally)
            for _ in range(BLOCK // 100):
                try_texts(rng, tally)
            try_server(rng, BLOCK // 40, tally)
            try_client(rng, BLOCK // 40, tally)
            bar.update(task, completed=tally.cases)
    print(
        f"{tally.cases} cases in {time.monotonic() - started:.0f} s, seed {arguments.seed}: "
        f"{tally.accepted} accepted, {tally.refused} refused, none else"
    )
    for target, n in sorted(tally.by_target.items()):
        print(f"  {target}: {n}")


if __name__ == "__main__":
    main()
