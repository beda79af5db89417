"""Random damage to the bytes of files.

Files are cut, flipped, doubled, or filled with NaN, infinities, zeros or huge counts.
"""

import struct
import time

SLOW_SECONDS = 20.0

NAN, INFINITE = float("nan"), float("inf")
VALUES = (
    *(struct.pack("<d", value) for value in (NAN, INFINITE, -1.0, 0.0)),
    *(struct.pack("<f", value) for value in (NAN, -INFINITE)),
    *(struct.pack("<Q", value) for value in (2**63, 2**40)),
    *(b"\xff" * 8, b"\0" * 32, struct.pack("<I", 2**32 - 1), struct.pack("<i", -1)),
)
WORDS = (*b"nan inf -1 0 99999999999999999999 x 1e400 - \xff".split(), b"", b"1 2 3", b"\n")


def cases(folder, first, count):
    """Yield the numbers of the cases, none of which may hang.

    ``FOLDER/current`` has the present one.
    """
    for case in range(first, first + count):
        (folder / "current").write_text(str(case))
        started = time.monotonic()
        yield case
        taken = time.monotonic() - started
        assert taken < SLOW_SECONDS, f"case {case} took {taken:.0f} s"


def corrupt(data, rng):
    """``data`` with one to three injuries, mostly one."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        injury = rng.choice((_cut, _flip, _overwrite, _insert, _remove, _word, _noise))
        data = injury(data, rng)
    return data


def _place(data, rng):
    """A position; near the start, where counts and headers are, half of the time."""
    end = min(len(data), 64) if rng.random() < 0.5 else len(data)
    return rng.randrange(end + 1)


def _cut(data, rng):
    return data[: _place(data, rng)]


def _flip(data, rng):
    changed = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        if changed:
            changed[min(_place(data, rng), len(changed) - 1)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _overwrite(data, rng):
    at, value = _place(data, rng), rng.choice(VALUES)
    return data[:at] + value + data[at + len(value) :]


def _insert(data, rng):
    at = _place(data, rng)
    return data[:at] + rng.randbytes(rng.randint(1, 16)) + data[at:]


def _remove(data, rng):
    at = _place(data, rng)
    return data[:at] + data[at + rng.randint(1, 16) :]


def _word(data, rng):
    """Replace one word of a text file."""
    words = data.split(b" ")
    words[rng.randrange(len(words))] = rng.choice(WORDS)
    return b" ".join(words)


def _noise(data, rng):
    return (
        rng.randbytes(rng.randint(0, 200))
        if rng.random() < 0.2
        else data + rng.randbytes(rng.randint(1, 40))
    )
