"""``gsbench explain``: how a table's number came about; with ``--stale``, why a stage is computed anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.explain import ADDRESS, explain_cell
from gsbench.errors import InputError
from gsbench.runs.layout import CONFIG, STORE
from gsbench.system.own_modules import allow_modules
from gsbench.verbs.arguments import ArgumentParser


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    if "--stale" in argv:
        return _stale([word for word in argv if word != "--stale"], runs)
    parser = ArgumentParser(
        prog="gsbench explain",
        description="The runs, settings, data and code versions behind a cell of a table.",
        epilog="gsbench explain --stale FOLDER tells why a stage of a trial is computed anew.",
    )
    parser.add_argument("cell", metavar="CELL", help=f"a number of a table: {ADDRESS}")
    print(explain_cell(parser.parse_args(argv).cell, runs))
    return 0


def _stale(argv: Sequence[str], runs: Path) -> int:
    """The verb with ``--stale``."""
    parser = ArgumentParser(
        prog="gsbench explain --stale",
        description="For each stage of a trial: whether its result is in the store; if not, what differs from the most "
        "similar result that is.",
    )
    parser.add_argument(
        "trial",
        nargs="+",
        metavar="FOLDER or KEY=VALUE",
        help="a trial's folder, with allow_targets=[mine] where it has code of yours; or the settings of one "
        "(scene=... densify=...)",
    )
    words = parser.parse_args(argv).trial
    from gsbench.app.command import compose_trials
    from gsbench.config.command_words import typed_permissions
    from gsbench.config.trust import PERMISSIONS
    from gsbench.pipeline.parts import Parts
    from gsbench.pipeline.wiring import TrialSteps
    from gsbench.renders.import_renders import is_entered
    from gsbench.runs.explain_cache import explain_steps
    from gsbench.runs.store import Store
    from gsbench.runs.trial_folder import TrialFolder

    places = [word for word in words if not word.startswith(f"{PERMISSIONS}=")]
    if len(places) == 1 and (Path(places[0]) / CONFIG).exists():
        allowed = typed_permissions([word for word in words if word not in places])
        allow_modules(allowed)
        values = TrialFolder(Path(places[0])).configuration() | {PERMISSIONS: list(allowed)}
        if is_entered(values):
            raise InputError(f"{places[0]} was entered from renders: it has no stages")
    elif "=" not in words[0]:
        raise InputError(f"{words[0]} is neither a trial's folder nor a setting like key=value")
    else:
        values = compose_trials(words)[0].values
    store = Store(runs / STORE)
    for line in explain_steps(TrialSteps(Parts(values), store).steps(), store):
        print(line)
    return 0
