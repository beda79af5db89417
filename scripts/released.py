"""Write ``src/gsbench/released.json``, the digests of this release's packages (CONTRIBUTING.md).

python scripts/released.py
"""

import itertools

from gsbench.files import write_json
from gsbench.runs.code import PACKAGE, RELEASED, digests_at_release
from gsbench.runs.keys import CODE_OF_STAGE


def main() -> None:
    packages = sorted({*itertools.chain(*CODE_OF_STAGE.values())})
    write_json(PACKAGE / RELEASED, {name: digests_at_release(name) for name in packages})


if __name__ == "__main__":
    main()
