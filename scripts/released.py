"""Write ``src/gsbench/released.json``, the digests of this release's rooms (docs/releasing.md).

python scripts/released.py
"""

from gsbench.files import write_json
from gsbench.runs import keys


def main() -> None:
    rooms = sorted({room for rooms in keys.ROOMS.values() for room in rooms})
    write_json(keys.PACKAGE / keys.RELEASED, {room: keys.room_digests(room) for room in rooms})


if __name__ == "__main__":
    main()
