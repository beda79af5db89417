"""A stage that is slow enough to be killed, for tests; it loads no torch.

It writes numbered lines, and continues where it was stopped. Run it as a program: ``python -m
tests.runs.toy STORE COUNT [--slow] [--ready]``. ``--ready`` prints a line when it begins.
"""

import logging
import os
import sys
import time
from pathlib import Path

from gsbench.runs.keys import Stage, Step
from gsbench.runs.store import Store

TOY = Stage("toy", 1, resumable=True, scratch=("*.progress",))
LINES = 40


def toy_inputs(number):
    return {"number": number}


def expected_text(number):
    return "".join(f"{number} {line}\n" for line in range(LINES))


def build(folder, number, pause):
    """Keep the lines so far in a file that is replaced as a whole, as a checkpoint is."""
    progress = folder / "so_far.progress"
    lines = progress.read_text().splitlines() if progress.exists() else []
    while len(lines) < LINES:
        lines.append(f"{number} {len(lines)}")
        time.sleep(pause)
        temporary = folder / f".so_far.tmp-{os.getpid()}"
        temporary.write_text("".join(line + "\n" for line in lines))
        os.replace(temporary, progress)
    (folder / "lines.txt").write_text("".join(line + "\n" for line in lines))


def main(argv):
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if "--ready" in argv:
        print("ready", flush=True)
    store = Store(Path(argv[0]))
    store.sweep([TOY])
    cached = []
    for number in range(int(argv[1])):
        pause = 0.05 if "--slow" in argv else 0.01
        cached.append(
            store.get(
                Step(TOY, toy_inputs(number), lambda folder, n=number, p=pause: build(folder, n, p))
            ).cached
        )
    print("found" if all(cached) else "built")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
