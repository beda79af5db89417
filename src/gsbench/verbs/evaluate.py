"""``gsbench evaluate``: measure renders of any program, and enter them beside the arms of an experiment."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError
from gsbench.eval.protocol import ALL, OTHERS
from gsbench.verbs.arguments import ArgumentParser

EVERY = "all"


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if every photograph was measured."""
    options = _parser().parse_intermixed_args(argv)
    if options.protocol == EVERY or options.truth is None:
        from gsbench.renders.translate import translate_trials

        _check_translation(options)
        translate_trials(options.renders, options.protocol, runs)
        return 0
    if options.protocol in OTHERS:
        raise InputError(
            f"--protocol {options.protocol} also says how photographs are shrunk, which is not known of --truth: enter "
            f"the renders with --as EXPERIMENT:ARM, then gsbench evaluate EXPERIMENT --protocol {options.protocol}"
        )
    from gsbench.renders.measure import measure_renders

    measure_renders(options, runs)
    return 0


def _check_translation(options: argparse.Namespace) -> None:
    """Refuse what only renders of other programs take."""
    given = {"--truth": options.truth, "--as": options.place, "--scene": options.scene, "--by-order": options.by_order}
    if options.protocol is None:
        raise InputError(
            "--truth is not given: say where the photographs are, or --protocol all for an experiment's trials"
        )
    for name, value in given.items():
        if value:
            raise InputError(f"--protocol {options.protocol} is for an experiment's own trials, which take no {name}")
    if options.settings:
        raise InputError(f"{options.settings[0]}: the trials of an experiment are measured as they were made")


def _parser() -> ArgumentParser:
    parser = ArgumentParser(
        prog="gsbench evaluate",
        description="Measure renders of any program against photographs, by the protocol that trials are measured by. "
        "Names are matched, never guessed; sizes must be equal. Or, without --truth, measure the trials of an "
        "experiment under the conventions of others.",
    )
    parser.add_argument(
        "renders",
        metavar="RENDERS",
        help="folder of pictures; without --truth: an experiment, or EXPERIMENT:SCENE:DENSIFY",
    )
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="settings of the scene, and eval.…")
    parser.add_argument(
        "--truth",
        metavar="PLACE",
        help="the photographs: a folder, a trial (folder or EXPERIMENT:SCENE:"
        "DENSIFY), or a scene's name, whose test views are taken as a trial sees them",
    )
    parser.add_argument("--protocol", choices=[*ALL, EVERY], help="default: that of the trial, or paper")
    parser.add_argument("--by-order", action="store_true", help="match sorted pictures with sorted photographs")
    parser.add_argument(
        "--as", dest="place", metavar="EXPERIMENT:ARM", help="enter them as a trial; ARM is a name, or INIT-NAME"
    )
    parser.add_argument("--seed", type=int, default=0, help="which repetition of the arm they are (0)")
    parser.add_argument("--scene", metavar="NAME", help="with --as, where PLACE is a folder: what to call the scene")
    parser.add_argument("--json", action="store_true", help="an object instead of a table")
    return parser
