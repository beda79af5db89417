"""The search for the commit that made a trainer worse: halving, where each step is a gate."""

from __future__ import annotations

import math
from collections.abc import Callable

from gsbench.claims.gate import PASSED, WORSE

SPARE = 2  # commits that may be left undecided, and passed over, before the search ends with a range


def most_steps(count: int) -> int:
    """The most gates that a search among ``count`` commits asks: the last one, halving, and those passed over.

    Examples:
        >>> most_steps(1), most_steps(12)
        (1, 7)
    """
    return 1 if count == 1 else 1 + math.ceil(math.log2(count)) + SPARE


def first_worse(count: int, result: Callable[[int], str | None]) -> tuple[int, int] | None:
    """(last good, first worse) of the commits 0, which is good, to ``count``; with others between, none is known.

    ``result`` gives a commit's answer against commit 0: `gsbench.claims.gate.PASSED`, ``WORSE`` or undecided; None of
    one that does not train, which costs no step. Quality is taken to have moved once. None where the last commit is not
    shown to be worse.

    Examples:
        >>> first_worse(12, lambda commit: WORSE if commit >= 7 else PASSED)
        (6, 7)
    """
    if result(count) != WORSE:
        return None
    good, bad, spare = 0, count, SPARE
    passed_over: set[int] = set()
    while left := [commit for commit in range(good + 1, bad) if commit not in passed_over]:
        commit = min(left, key=lambda one: abs(2 * one - good - bad))
        answer = result(commit)
        if answer == PASSED:
            good = commit
        elif answer == WORSE:
            bad = commit
        elif answer is not None and not spare:
            break
        else:
            passed_over.add(commit)
            spare -= answer is not None
    return good, bad
