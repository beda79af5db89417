"""``gsbench explain``: how a table's number came about; with ``--stale``, why a stage is computed anew."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from gsbench.errors import InputError


def main(argv: list[str]) -> int:
    from gsbench.cli import runs_dir

    if "--stale" in argv:
        return main_stale([word for word in argv if word != "--stale"], runs_dir())
    from gsbench.analysis.explain import main_explain

    return main_explain(argv, runs_dir())


def main_stale(argv: Sequence[str], runs: Path) -> int:
    """The verb with ``--stale``; returns the exit code, raises ``InputError`` for bad input."""
    parser = argparse.ArgumentParser(
        prog="gsbench explain --stale",
        description="For each stage of a trial: whether its result is in the store; if not, what differs from the most "
        "similar result that is.",
    )
    parser.add_argument("trial", nargs="+", help="a trial's folder, or the settings of one (scene=... densify=...)")
    words = parser.parse_args(argv).trial
    from gsbench.compose import compose_trials
    from gsbench.pipeline.stale import explain_steps
    from gsbench.pipeline.store import Store
    from gsbench.pipeline.trial_files import CONFIG, read_config
    from gsbench.pipeline.wiring import Parts, Trial

    if len(words) == 1 and (Path(words[0]) / CONFIG).exists():
        values = read_config(Path(words[0]))
    elif "=" not in words[0]:
        raise InputError(f"{words[0]} is neither a trial's folder nor a setting like key=value")
    else:
        values = compose_trials(words)[0].values
    store = Store(runs / "store")
    for line in explain_steps(Trial(Parts.of(values), store).steps(), store):
        print(line)
    return 0
