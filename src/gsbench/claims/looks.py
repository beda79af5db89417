"""Adding seeds in planned looks until every question is decided."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from gsbench.analysis.judgement import Verdict
from gsbench.runs.declaration import Declaration
from gsbench.words import counted

log = logging.getLogger(__name__)

Planned = tuple[str, int]  # folder of a trial within its experiment, without the seed; and the seed


def trials_of_look(declaration: Declaration, places: Sequence[int], seeds: int) -> list[Planned]:
    """The trials that the questions at ``places`` need for their first ``seeds`` seeds, a seed after the other."""
    questions = [declaration.questions[k] for k in places]
    needed = [
        (question.seeds[rank], rank, key)
        for question in questions
        for rank in range(min(seeds, len(question.seeds)))
        for both in question.scenes.values()
        for key in both
    ]
    return list(dict.fromkeys((key, seed) for seed, _, key in sorted(needed, key=lambda one: one[1])))


def run_looks(
    declaration: Declaration,
    judged: Callable[[], list[Verdict]],
    run: Callable[[list[Planned]], object],
) -> list[Verdict]:
    """The verdicts, with seeds added look by look; ``judged`` gives those so far, ``run`` runs trials that are not
    done.

    A question whose trials failed waits; the others go on.
    """
    waiting: set[int] = set()
    verdicts = judged()
    for seeds in declaration.looks:
        left = [k for k, verdict in enumerate(verdicts) if not verdict.final and k not in waiting]
        if not left:
            break
        if needed := trials_of_look(declaration, left, seeds):
            log.info("seeds up to %d: %s for %s", seeds, counted(len(needed), "trial"), counted(len(left), "question"))
            run(needed)
        verdicts = judged()
        waiting |= {k for k in left if not verdicts[k].final and verdicts[k].pairs.seeds < seeds}
    return verdicts
