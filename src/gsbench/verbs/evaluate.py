"""``gsbench evaluate``: measure renders of any program, and enter them beside the arms of an experiment."""

from collections.abc import Sequence
from pathlib import Path

from gsbench.eval.protocol import PROTOCOLS
from gsbench.verbs.arguments import ArgumentParser


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if every photograph was measured."""
    from gsbench.renders.measure import measure_renders

    measure_renders(_parser().parse_intermixed_args(argv), runs)
    return 0


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog="gsbench evaluate",
        description="Measure renders of any program against photographs, by the protocol that trials are measured by. "
        "Names are matched, never guessed; sizes must be equal.",
    )
    parser.add_argument("renders", metavar="RENDERS", help="folder of pictures")
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="settings of the scene, and eval.…")
    parser.add_argument(
        "--truth",
        metavar="PLACE",
        required=True,
        help="the photographs: a folder, a trial (folder or EXPERIMENT:SCENE:"
        "DENSIFY), or a scene's name, whose test views are taken as a trial sees them",
    )
    parser.add_argument("--protocol", choices=list(PROTOCOLS), help="default: that of the trial, or paper")
    parser.add_argument("--by-order", action="store_true", help="match sorted pictures with sorted photographs")
    parser.add_argument(
        "--as", dest="place", metavar="EXPERIMENT:ARM", help="enter them as a trial; ARM is a name, or INIT-NAME"
    )
    parser.add_argument("--seed", type=int, default=0, help="which repetition of the arm they are (0)")
    parser.add_argument("--scene", metavar="NAME", help="with --as, where PLACE is a folder: what to call the scene")
    parser.add_argument("--json", action="store_true", help="print a JSON object instead of a table")
    return parser
