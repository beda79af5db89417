"""The verdicts of a pair of arms in words."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.results import Arm
from gsbench.analysis.statistics import ALPHA
from gsbench.analysis.verdicts import (
    WORDS,
    ArmVerdict,
    ArmVerdicts,
    beyond_words,
    outlying_words,
    scope,
    sign_words,
)

OPENINGS = {
    "better": "better in",
    "worse": "worse in",
    "too small to matter": "too small to matter in",
    "undecided": "undecided in",
}


def headline(judged: ArmVerdicts, first: Arm, second: Arm) -> str:
    """The verdicts on a pair of arms in one sentence, the declared metric's alone where there is one."""
    verdicts, against = judged.verdicts, f"{second} against {first}"
    if not verdicts:
        return f"{second} and {first} cannot be compared: no metric has paired trials."
    where = scope(verdicts[0].verdict)
    if all(one.verdict.equal for one in verdicts):
        return (
            f"{against}, on {where}: equal in every metric, to the last bit. What "
            "they differ in never acted: look at the events, and at train.densify_start and densify_stop."
        )
    if all(one.verdict.interval is None for one in verdicts):
        return f"{against}: no verdict, one trial of each on {where}; run more seeds."
    if judged.declared is None:
        return f"{against}, on {where}: {_in_words(verdicts)}.{_beyond(verdicts)}"
    if judged.missing:
        return (
            f"{against}: no verdict, since {judged.declared.name}, which was declared, has no value ({judged.missing})."
        )
    if verdicts[0].role != "declared":
        adjusted = ", all metrics adjusted for their number"
        return f"{against}, on {where}{adjusted}: {_in_words(verdicts)}.{_beyond(verdicts)}"
    return f"{against}, on {where}: {_in_words(verdicts[:1])}, which was declared beforehand.{_beyond(verdicts[:1])}"


def secondary(judged: ArmVerdicts) -> str:
    """Headlines of the secondary metrics, where one was declared and they can be decided."""
    others = [one for one in judged.verdicts if one.role == "secondary"]
    decidable = any(one.verdict.interval is not None for one in others)
    return f"Secondary, adjusted for their number: {_in_words(others)}." if decidable else ""


def _in_words(verdicts: Sequence[ArmVerdict]) -> str:
    """``better in PSNR; undecided in SSIM, FLIP``"""
    words = []
    for word, opening in OPENINGS.items():
        names = [f"{one.quantity.name}{sign_words(one.verdict)}" for one in verdicts if one.word == word]
        if names:
            words.append(f"{opening} {', '.join(names)}")
    return "; ".join(words)


def _beyond(verdicts: Sequence[ArmVerdict]) -> str:
    """`` Scenes like these: better in PSNR (8 of 8 scenes).`` of what was decided about these scenes."""
    words = [
        f"{WORDS[one.verdict.like_these.outcome]} in {one.quantity.name} ({one.verdict.like_these.helped} of "
        f"{one.verdict.like_these.scenes} scenes)"
        for one in verdicts
        if one.word != "undecided" and one.verdict.like_these is not None
    ]
    return f" Scenes like these: {'; '.join(words)}." if words else ""


def detail_lines(verdicts: Sequence[ArmVerdict]) -> list[str]:
    """A line for each metric that says more than its row: scenes like these, trials far outside the others."""
    lines = []
    for one in verdicts:
        details = [*beyond_words(one.verdict), *outlying_words(one.verdict)]
        lines += [f"{one.quantity.name}: {line}" for line in details]
    return lines


def by_scene_lines(verdicts: Sequence[ArmVerdict]) -> list[str]:
    """A line for each metric in which single scenes are decided (p below 5 %, adjusted), which names them.

    A mean over scenes that disagree hides both sides of what was found.
    """
    lines = []
    for one in verdicts:
        scenes = one.verdict.scenes
        decided = [scene for scene in scenes if scene.p is not None and scene.p < ALPHA]
        better = [scene.scene for scene in decided if scene.mean * one.quantity.direction > 0]
        worse = [scene.scene for scene in decided if scene.mean * one.quantity.direction < 0]
        found = [f"{word} on {', '.join(names)}" for word, names in (("better", better), ("worse", worse)) if names]
        if len(scenes) > 1 and found:
            warning = ": the scenes disagree, so their mean says little" if len(found) > 1 else ""
            lines.append(f"{one.quantity.name} by scene: {', '.join(found)}{warning}")
    return lines
