"""The verdicts of a pair of arms in words."""

from __future__ import annotations

from collections.abc import Sequence

from gsbench.analysis.pairing import arm_name
from gsbench.analysis.results import Arm
from gsbench.analysis.statistics import ALPHA
from gsbench.analysis.verdicts import ArmVerdicts, Verdict


def headline(judged: ArmVerdicts, first: Arm, second: Arm) -> str:
    """The verdicts on a pair of arms in one sentence, the declared metric's alone where there is one."""
    verdicts, against = judged.verdicts, f"{arm_name(second)} against {arm_name(first)}"
    if not verdicts:
        return f"{arm_name(second)} and {arm_name(first)} cannot be compared: no metric has paired trials."
    scope = verdicts[0].comparison.scope
    if all(scene.mean == 0 for verdict in verdicts for scene in verdict.comparison.scenes):
        return (
            f"{against}, on {scope}: equal in every metric, to the last bit. What "
            "they differ in never acted: look at the events, and at train.densify_start and densify_stop."
        )
    if all(verdict.comparison.p is None for verdict in verdicts):
        return f"{against}: no verdict, one trial of each on {scope}; run more seeds."
    if judged.declared is None:
        return f"{against}, on {scope}: {_in_words(verdicts)}.{_beyond(verdicts)}"
    if judged.missing:
        return (
            f"{against}: no verdict, since {judged.declared.name}, which was declared, has no value ({judged.missing})."
        )
    if verdicts[0].role != "declared":
        adjusted = ", all metrics adjusted for their number"
        return f"{against}, on {scope}{adjusted}: {_in_words(verdicts)}.{_beyond(verdicts)}"
    return f"{against}, on {scope}: {_in_words(verdicts[:1])}, which was declared beforehand.{_beyond(verdicts[:1])}"


def secondary(judged: ArmVerdicts) -> str:
    """Headlines of the secondary metrics, where one was declared and they can be decided."""
    others = [verdict for verdict in judged.verdicts if verdict.role == "secondary"]
    decidable = any(verdict.comparison.p is not None for verdict in others)
    return f"Secondary, adjusted for their number: {_in_words(others)}." if decidable else ""


def _in_words(verdicts: Sequence[Verdict]) -> str:
    """``better in PSNR; no evidence of a difference in SSIM, FLIP``"""
    words = []
    for word, opening in (
        ("better", "better in"),
        ("worse", "worse in"),
        ("no evidence", "no evidence of a difference in"),
    ):
        names = [v.quantity.name for v in verdicts if v.comparison.verdict == word]
        if names:
            words.append(f"{opening} {', '.join(names)}")
    return "; ".join(words)


def _beyond(verdicts: Sequence[Verdict]) -> str:
    """`` It holds for scenes like these in PSNR; not shown for scenes like these in SSIM.`` of what was decided."""
    words = []
    for holds, opening in ((True, "it holds"), (False, "not shown")):
        found = [(v.quantity.name, v.comparison) for v in verdicts if v.comparison.verdict != "no evidence"]
        names = [name for name, one in found if one.beyond is not None and one.beyond.holds == holds]
        if names:
            words.append(f"{opening} for scenes like these in {', '.join(names)}")
    text = "; ".join(words)
    return f" {text[0].upper()}{text[1:]}." if text else ""


def by_scene_lines(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for each metric in which single scenes are decided (p below 5 %, adjusted), which names them.

    A mean over scenes that disagree hides both sides of what was found.
    """
    lines = []
    for verdict in verdicts:
        scenes = verdict.comparison.scenes
        decided = [scene for scene in scenes if scene.p_family is not None and scene.p_family < ALPHA]
        better = [scene.scene for scene in decided if scene.mean * verdict.quantity.direction > 0]
        worse = [scene.scene for scene in decided if scene.mean * verdict.quantity.direction < 0]
        found = [f"{word} on {', '.join(names)}" for word, names in (("better", better), ("worse", worse)) if names]
        if len(scenes) > 1 and found:
            warning = ": the scenes disagree, so their mean says little" if len(found) > 1 else ""
            lines.append(f"{verdict.quantity.name} by scene: {', '.join(found)}{warning}")
    return lines
