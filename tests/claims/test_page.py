"""The page of a check: which scenes its verdicts speak of."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gsbench.claims.page import _scope
from gsbench.claims.verdict import NOT_TESTABLE, judge_claim
from tests.claims.test_verdict import MakePairs, claim_with

SIX = tuple("abcdef")


@pytest.mark.parametrize(("scenes", "words"), [(SIX[:5], "these scenes"), (SIX, "scenes like these, which are")])
def test_from_six_scenes_on_verdicts_speak_of_scenes_like_these(
    make_pairs: MakePairs, scenes: tuple[str, ...], words: str
) -> None:
    claim, file = claim_with()
    found = judge_claim(claim, file, make_pairs(scenes=scenes, seeds=range(4)), scenes)
    untested = replace(found, word=NOT_TESTABLE, design=replace(found.design, scenes=11 - len(scenes)))
    assert _scope([found, untested]).startswith(words)
    assert "from six on" in _scope([found, replace(untested, word="undecided")])
