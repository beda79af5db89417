"""``gsbench pool``: one answer from many archives of results."""

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.pairing import BASELINE
from gsbench.analysis.quantities import asked_quantity
from gsbench.claims.pooling import Pooled, PooledQuestion, describe, pool, read_studies
from gsbench.errors import InputError
from gsbench.verbs.arguments import ArgumentParser, add_where, names, path

DONE, LEFT_OUT = 0, 1
BETTER = {1: ", more is better", -1: ", less is better", 0: ""}


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0, or 1 if a source was left out; raises InputError if none can be read."""
    parser = ArgumentParser(
        prog="gsbench pool",
        description="A mean over many archives of `gsbench export --results`, each with the same weight.",
    )
    parser.add_argument("sources", nargs="+", type=path, metavar="ARCHIVE")
    parser.add_argument("--arm", type=names, required=True, help="a densifier; names it goes by, comma between")
    parser.add_argument(
        "--baseline", type=names, default=(BASELINE,), help=f"the densifier to compare with ({BASELINE})"
    )
    parser.add_argument("--metric", default="psnr", help="such as psnr (the default), ssim, lpips_vgg")
    add_where(parser)
    parser.add_argument("--protocol", help="only studies by this one, such as paper-1")
    options = parser.parse_args(argv)
    wanted = PooledQuestion(options.arm, options.baseline, options.metric, dict(options.where))
    pooled, notes, faults = pool_sources(options.sources, wanted, options.protocol)
    title = f"{options.arm[0]} against {options.baseline[0]}"
    shown = asked_quantity(options.metric)
    lines = [f"{title}, difference in {shown.name}{BETTER[shown.direction]}", "", *_rows(pooled), ""]
    lines += [*describe(pooled), *notes, *faults]
    print("\n".join(lines))
    for fault in faults:
        print(f"gsbench: {fault}", file=sys.stderr)
    return LEFT_OUT if faults else DONE


def pool_sources(
    sources: Sequence[Path], wanted: PooledQuestion, protocol: str | None = None
) -> tuple[Pooled, list[str], list[str]]:
    """Pool all studies in ``sources``: (their mean, notes on them, a line for each source or study that is left out).

    Raises InputError if no study is left.
    """
    studies, notes, faults = [], list[str](), list[str]()
    seen: dict[str, Path] = {}
    stems = Counter(source.stem for source in sources)
    for source in sources:
        try:
            archive = read_studies(source, wanted, source.stem if stems[source.stem] == 1 else str(source))
        except InputError as error:
            faults.append(f"left out: {error}")
            continue
        if twice := archive.trials & seen.keys():
            faults.append(f"left out: {source} has trials that {seen[min(twice)]} has, and they would count twice")
            continue
        seen |= dict.fromkeys(archive.trials, source)
        notes += archive.notes
        for study in archive.studies:
            if protocol is not None and study.protocol != protocol:
                notes.append(f"{study.name}: not asked for, it is by {study.protocol}")
            elif study.interval is None:
                faults.append(f"left out: {study.name} has one pair of trials: nothing tells how sure it is")
            else:
                studies.append(study)
    if not studies:
        raise InputError((faults or notes)[0].removeprefix("left out: "))
    return pool(studies), notes, faults


def _rows(pooled: Pooled) -> list[str]:
    lines = ["| study | difference | 95 % interval | protocol |", "|---|---|---|---|"]
    for study in pooled.studies:
        interval = "unknown" if study.interval is None else f"{study.interval.low:+.4g} to {study.interval.high:+.4g}"
        lines.append(f"| {study.name} | {study.effect:+.4g} | {interval} | {study.protocol} |")
    return lines
