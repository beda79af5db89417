"""``gsbench site``: a static site from archives of results."""

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gsbench.files import writable_output
from gsbench.verbs.arguments import ArgumentParser, path

DONE, LEFT_OUT = 0, 1


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0, or 1 if an archive was left out; raises InputError if none can be read."""
    from gsbench.claims.site import INDEX, write_site  # here, for a quick answer to --help

    parser = ArgumentParser(
        prog="gsbench site",
        description="Write a static site from archives (gsbench export --results); it needs no server. It has sortable "
        "tables of arms and scenes, all verdicts, and the report of each, with pictures if the archive has them.",
    )
    parser.add_argument("archives", nargs="+", type=path, metavar="ARCHIVE")
    parser.add_argument("--out", type=path, required=True, metavar="DIR", help="the folder to write into")
    parser.add_argument("--title", default="Results of gsbench", help="of its first page")
    options = parser.parse_args(argv)
    page = options.out / INDEX
    with tempfile.TemporaryDirectory() as scratch, writable_output(page):
        left_out = write_site(options.archives, options.out, options.title, Path(scratch))
    for line in left_out:
        print(f"gsbench: left out: {line}", file=sys.stderr)
    print(page)
    return LEFT_OUT if left_out else DONE
