"""docs/findings.md says what the archives beside it say."""

from __future__ import annotations

import re
import zipfile
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from tests.conftest import ROOT
from tests.docs import findings_said

NAME = "findings_matched"
ARMS = ("volumetric", "volumetric_once", "longaxis")
BETWEEN, BEYOND = "interpolation", "extrapolation"


@pytest.fixture(scope="module")
def scripts() -> ModuleType:
    return findings_said.script()


@pytest.fixture(scope="module")
def page(scripts: ModuleType) -> str:
    text: str = (scripts.DOCS / "findings.md").read_text(encoding="utf-8")
    return text


@pytest.fixture(scope="module")
def prose(page: str) -> str:
    """The page without tables and marks of emphasis, on one line."""
    lines = [line for line in re.sub(r"<!--.*?-->", "", page).splitlines() if not line.startswith(("|", "    "))]
    return re.sub(r"\s+", " ", re.sub(r"[*`]", "", " ".join(lines)))


def said(value: float, digits: int) -> str:
    """A number as the page writes it: a true minus, and no zero before the point."""
    text = f"{value:+.{digits}f}".replace("-", "−")
    return text.replace("0.", ".", 1) if abs(value) < 1 else text


def test_tables_are_made_again_from_the_archives(scripts: ModuleType, page: str) -> None:
    assert len(scripts.SECTION.findall(page)) >= 3
    assert scripts.with_tables(page) == page
    assert "nan" not in page


def test_every_file_and_experiment_that_the_page_names_is_there(scripts: ModuleType, page: str) -> None:
    for name in re.findall(r"\((findings/[^)]+)\)", page):
        assert (scripts.DOCS / name).is_file(), name
    for name in re.findall(r"\+experiment=(\w+)", page):
        assert (ROOT / "conf" / "experiment" / f"{name}.yaml").is_file(), name
    for name in re.findall(r"conf/claims/\w+\.yaml", page):
        assert (ROOT / name).is_file(), name


def test_the_answer_on_eight_scenes_is_that_of_the_archive(scripts: ModuleType, prose: str) -> None:
    archives = scripts.archives
    verdicts = {verdict.claim.id: verdict for verdict in archives.checked("findings_volume").verdicts}
    assert {verdict.word for verdict in verdicts.values()} == {"undecided"}
    assert {verdict.design.by_scene for verdict in verdicts.values()} == {True}
    texts = []
    for claim in ("rule_between_cameras", "rule_where_no_camera_went"):
        decision = verdicts[claim].decision
        texts.append(f"{said(decision.mean, 3)} [{said(decision.interval.low, 3)}, {said(decision.interval.high, 3)}]")
    assert f"the mean is {texts[0]} between, {texts[1]} where none went" in prose
    frame = archives.read_trials("findings_volume")
    near, far = (
        dict(zip(pair.scenes, (matrix.ravel() for matrix in pair.differences), strict=True))
        for question in (BETWEEN, BEYOND)
        for pair in [archives.paired(frame, "volumetric", "lpips_squeeze", "adc", question)]
    )
    assert len(near) == len(far) == 8
    assert max(near["flower"].max(), far["flower"].max()) < 0
    fall, further = (f"{-own['flower'].mean():.3f}".lstrip("0") for own in (near, far))
    assert f"lowers LPIPS by {fall} between the cameras and by {further} where no camera went, in each of four" in prose
    others = {scene: values.mean() for scene, values in near.items() if scene != "flower"}
    most = f"{max(abs(value) for value in others.values()):.3f}".lstrip("0")
    assert f"the other seven it moves LPIPS by {most} at most between the cameras, to either side" in prose
    assert min(others.values()) < 0 < max(others.values())
    seven = stats.ttest_1samp(list(others.values()), 0).confidence_interval()
    mean = said(float(np.mean(list(others.values()))), 3)
    assert f"have a mean of {mean} [{said(seven.low, 3)}, {said(seven.high, 3)}] between the cameras" in prose
    first_screen = re.sub(r"\s+", " ", (ROOT / "README.md").read_text(encoding="utf-8").split("## Two commands")[0])
    found = verdicts["rule_between_cameras"].decision
    assert (
        f"lowers LPIPS by {fall} on the scene of foliage, in each seed, and moves it by {most} at most" in first_screen
    )
    low, high = said(found.interval.low, 3), said(found.interval.high, 3)
    assert f"undecided (mean {said(found.mean, 3)}, interval {low} to {high}, scenes as the units)" in first_screen
    seeds = ", ".join(said(value, 3) for value in far["herz_jesus"])
    assert f"Seeds differ there by more than rules do (LPIPS {seeds})" in prose


def test_what_is_said_of_how_much_the_rule_acts_is_so(scripts: ModuleType, prose: str) -> None:
    archives = scripts.archives
    frame = archives.read_trials("findings_volume")
    shares = archives.volume_shares(frame).xs("volumetric", level="arm").sort_values(ascending=False)
    assert list(shares.index[:2]) == ["flower", "courtyard"]
    flower, courtyard, rest = (f"{shares.iloc[k]:.2f}".lstrip("0") for k in range(3))
    assert f"On flower {flower} of all that grows is split by volume, on the courtyard {courtyard}, on the" in prose
    assert f"on the other six {rest} or less" in prose
    gains = archives.gains_between(frame, "volumetric", "lpips_squeeze", "adc")
    assert abs(gains["courtyard"]) < 0.005


def test_the_answer_in_one_minute_is_that_of_the_trials(scripts: ModuleType, prose: str) -> None:
    archives = scripts.archives
    found = archives.compared(NAME, ARMS, "adc")
    for question, arm, metric, digits in (
        (BETWEEN, "volumetric", "lpips_squeeze", 3),
        (BETWEEN, "longaxis", "lpips_squeeze", 3),
        (BETWEEN, "longaxis", "ssim", 3),
    ):
        c = found[question, arm, metric]
        sentence = f"{said(c.mean, digits)} [{said(c.interval.low, digits)}, {said(c.interval.high, digits)}]"
        assert sentence in prose
    for metric in ("lpips_squeeze", "ssim"):
        assert found[BETWEEN, "longaxis", metric].p_family < 0.001
    gains = [found[question, arm, "psnr"].mean for arm in ("volumetric", "longaxis") for question in (BETWEEN, BEYOND)]
    one, smaller, other, less = (said(gain, 2).lstrip("+") for gain in gains)
    assert f"the rule's gain of {one} dB becomes {smaller}, the long axis' {other} becomes {less}" in prose
    assert len(found) == 36
    assert {c.verdict for (_, arm, _), c in found.items() if arm.startswith("volumetric")} == {"no evidence"}


def test_what_is_said_of_scenes_is_so(scripts: ModuleType, prose: str) -> None:
    archives = scripts.archives
    frame = archives.read_trials(NAME)
    assert len(frame) == 72
    assert set(frame.groupby(["scene", "arm", "question"]).size()) == {3}
    by_scene = {
        (arm, metric, question): dict(zip(pair.scenes, (matrix.ravel() for matrix in pair.differences), strict=True))
        for arm in ARMS
        for metric in ("psnr", "lpips_squeeze")
        for question in (BETWEEN, BEYOND)
        for pair in [archives.paired(frame, arm, metric, "adc", question)]
    }
    near, far = (by_scene["volumetric", "psnr", question]["flower"] for question in (BETWEEN, BEYOND))
    ranges = [f"{values.min():.1f} to {values.max():.1f} dB" for values in (near, far)]
    assert f"by {ranges[0]} between the cameras and by {ranges[1]} where no camera went, in each" in prose
    lpips = by_scene["volumetric", "lpips_squeeze", BETWEEN]
    said_by_scene = [said(lpips[scene].mean(), 3) for scene in ("flower", "courtyard", "kitchen")]
    assert "{}, {} and {}".format(*said_by_scene) in prose
    long_axis = by_scene["longaxis", "lpips_squeeze", BETWEEN]
    assert all(long_axis[scene].mean() < 0 for scene in ("flower", "courtyard", "kitchen"))
    falls = frame.groupby(["arm", "question", "scene"]).psnr.mean().groupby(["arm", "question"]).mean().unstack()
    lost = falls[BETWEEN] - falls[BEYOND]
    assert f"Every arm loses {lost.min():.1f} to {lost.max():.1f} dB" in prose
    order = [falls[question].sort_values().index.tolist() for question in (BETWEEN, BEYOND)]
    assert order[0][0] == order[1][0] == "adc"
    assert order[0][-1] == order[1][-1] == "longaxis"


def test_the_verdicts_of_the_papers_claims_are_made_again(scripts: ModuleType, prose: str) -> None:
    verdicts = scripts.archives.checked("check_volumetric").verdicts
    words = [verdict.word for verdict in verdicts]
    assert words.count("undecided") == 5
    assert words.count("not testable here") == 2
    assert "Five claims are undecided and two cannot be tested here" in prose
    means = {verdict.claim.id: verdict.decision.mean for verdict in verdicts if verdict.decision is not None}
    assert means["more_gaussians"] > 0
    assert means["training_time"] > 0
    assert means["lower_lpips"] < 0
    assert means["grass_and_foliage"] < 0
    counts = dict(next(verdict.by_scene for verdict in verdicts if verdict.claim.id == "more_gaussians"))
    assert counts["courtyard"] < 0 < min(counts["kitchen"], counts["flower"])
    assert {100 * (1 - verdict.design.alpha) for verdict in verdicts if verdict.design} == {99.0}


def test_what_is_said_of_the_exponent_alone_is_so(scripts: ModuleType, prose: str) -> None:
    archives = scripts.archives
    c = archives.compared("findings_exponent", ("volumetric-1",), "volumetric")[BETWEEN, "volumetric-1", "psnr"]
    low, high = said(c.interval.low, 2), said(c.interval.high, 2)
    cost = said(-c.mean, 2).lstrip("+")
    assert f"That costs {cost} dB [{low}, {high}], p {c.p_family:.3f}".replace("p 0.", "p .") in prose
    assert c.family == 6
    share = archives.volume_shares(archives.read_trials("findings_exponent"))
    one, three = (share.xs(arm, level="arm") for arm in ("volumetric-1", "volumetric"))
    texts = [f"{value:.2f}".lstrip("0") for scene in ("courtyard", "flower") for value in (one[scene], three[scene])]
    sentence = "takes {} of what it clones or splits on the courtyard (with 3: {}), on flower {} ({})"
    assert sentence.format(*texts) in prose


def test_what_is_said_of_more_of_the_rule_is_so(scripts: ModuleType, prose: str) -> None:
    archives = scripts.archives
    name, arms = "findings_dimension", ("volumetric-1", "volumetric_once-1")
    verdicts = archives.checked(name).verdicts
    assert {(verdict.word, verdict.design.by_scene, verdict.beforehand) for verdict in verdicts} == {
        ("undecided", True, True)
    }
    frame = archives.read_trials(name)
    assert len(frame) == 192
    assert set(frame.groupby(["scene", "arm", "question"]).size()) == {4}
    found = {
        (arm, question): dict(zip(pair.scenes, (matrix.ravel() for matrix in pair.differences), strict=True))
        for arm in arms
        for question in (BETWEEN, BEYOND)
        for pair in [archives.paired(frame, arm, "lpips_squeeze", "adc", question)]
    }
    assert all(values["flower"].max() < 0 for values in found.values())
    falls = [-found[arm, question]["flower"].mean() for arm in arms for question in (BETWEEN, BEYOND)]
    texts = [said(value, 3).lstrip("+") for value in falls]
    sentence = "falls by {} between the cameras and by {} where none went (volumetric_once: {} and {}), in each of four"
    assert sentence.format(*texts) in prose
    near = found[arms[0], BETWEEN]
    one, three = (
        archives.volume_shares(archives.read_trials(experiment)).xs(arm, level="arm")
        for experiment, arm in ((name, arms[0]), ("findings_volume", "volumetric"))
    )
    shares = [f"{own[scene]:.2f}".lstrip("0") for scene in ("bonsai", "courtyard", "caliterra") for own in (one, three)]
    rises = [said(near[scene].mean(), 3).lstrip("+") for scene in ("bonsai", "courtyard", "caliterra")]
    assert (
        "{} of what grows on bonsai (with 3: {}), {} on the courtyard ({}) and {} on caliterra ({})".format(*shares)
        in prose
    )
    assert "LPIPS is higher by {}, {} and {}; on bonsai, courtyard and kitchen in each of four".format(*rises) in prose
    assert all(near[scene].min() > 0 for scene in ("bonsai", "courtyard", "kitchen"))
    rest = [values.mean() for scene, values in near.items() if scene != "flower"]
    assert f"nobody declared: {_with_interval(rest)}" in prose
    kitchen = [found[arm, BETWEEN]["kitchen"].mean() for arm in arms]
    assert f"On kitchen only {one['kitchen']:.2f}".replace("0.", ".") in prose
    assert "LPIPS rises by {} and {}".format(*(said(value, 3).lstrip("+") for value in kitchen)) in prose
    texts = []
    for experiment, (rule, once) in ((name, arms), ("findings_volume", ("volumetric", "volumetric_once"))):
        pair = archives.paired(archives.read_trials(experiment), once, "lpips_squeeze", rule, BETWEEN)
        texts.append(_with_interval([matrix.mean() for matrix in pair.differences]))
    assert f"between the cameras here: {texts[0]}; with the exponent 3 it is not: {texts[1]}" in prose


def _with_interval(values: list[float]) -> str:
    """Write the mean of scenes with the plain t interval of 95 %."""
    interval = stats.ttest_1samp(values, 0).confidence_interval()
    return f"{said(float(np.mean(values)), 3)} [{said(interval.low, 3)}, {said(interval.high, 3)}]"


@pytest.mark.parametrize(
    "name",
    [
        "check_volumetric",
        "findings_dimension",
        "findings_exponent",
        "findings_matched",
        "findings_volume",
        "scale_bridge",
    ],
)
def test_published_archives_name_no_folder_of_a_machine(scripts: ModuleType, name: str) -> None:
    with zipfile.ZipFile(scripts.archives.archive_of(name)) as archive:
        for member in archive.namelist():
            assert not re.search(rb"/(root|home|work|tmp|Users)/", archive.read(member)), member


def test_what_is_said_of_small_and_large_is_so(scripts: ModuleType, prose: str) -> None:
    """Against the trials themselves, without `gsbench.analysis.trends`."""
    frame = scripts.archives.read_trials("scale_bridge")
    assert (len(frame), set(frame.scene)) == (168, {"courtyard", "flower", "kitchen"})
    assert set(frame.groupby(["scene", "arm", "scene.max_size", "train.iterations"]).size()) == {2}
    keys = ["arm", "scene", "scene.max_size", "train.iterations", "seed"]
    values = frame.set_index(keys)[["lpips_squeeze", "psnr"]]
    rule, split = values.xs("volumetric_once") - values.xs("adc"), values.xs("longaxis") - values.xs("absgrad")
    scenes = {
        scene: {arm: found.xs(scene, level="scene") for arm, found in (("rule", rule), ("split", split))}
        for scene in ("flower", "kitchen", "courtyard")
    }
    flower = scenes["flower"]

    def by(found: pd.DataFrame, metric: str, *keys: tuple[int, int]) -> list[float]:
        """Means over seeds at (px, iterations)."""
        return [float(found[metric].xs(key, level=("scene.max_size", "train.iterations")).mean()) for key in keys]

    sizes = [(size, 5000) for size in (120, 160, 256, 320, 480)]
    lengths = [(256, length) for length in (2000, 5000, 15000)]
    one, other = by(flower["rule"], "lpips_squeeze", *sizes), by(flower["rule"], "psnr", *sizes)
    assert (flower["rule"].lpips_squeeze < 0).all()
    assert (flower["rule"].psnr > 0).all()
    assert "LPIPS falls by {}, {}, {}, {} and {}".format(*(said(-v, 3).lstrip("+") for v in one)) in prose
    assert f"PSNR goes from {said(other[0], 2)} dB at 120 px to {said(other[-1], 2)} dB at 480" in prose
    share = 100 * one[1] / one[-1]
    assert f"{share:.0f} % of what is there at 480" in prose
    far = by(flower["rule"], "lpips_squeeze", *lengths)
    assert "{}, {} and {} after 2,000, 5,000 and 15,000 iterations".format(*(said(v, 3) for v in far)) in prose
    shares = scripts.archives.volume_shares(frame)
    for scene in ("kitchen", "courtyard"):
        turns = [by(scenes[scene]["rule"], "lpips_squeeze", key)[0] for key in [*sizes, lengths[0], lengths[2]]]
        assert min(turns) < 0 < max(turns)
        assert re.search(f"between {said(min(turns), 3)}( LPIPS)? and {re.escape(said(max(turns), 3))}", prose)
    acts = [f"{100 * shares[scene, 'volumetric_once']:.0f} %" for scene in ("courtyard", "kitchen")]
    assert f"At {acts[0]} and {acts[1]} of what grows" in prose

    def mean(metric: str, key: tuple[int, int]) -> float:
        """Of the long axis over scenes."""
        return float(np.mean([by(scene["split"], metric, key)[0] for scene in scenes.values()]))

    psnr = [mean("psnr", key) for key in sizes]
    assert all(by(scene["split"], "psnr", key)[0] > 0 for scene in scenes.values() for key in sizes)
    least, most = (said(value, 2).lstrip("+") for value in (min(psnr), max(psnr)))
    assert f"PSNR by {least} to {most} dB in the mean of five sizes" in prose
    assert f"PSNR rises by {least} to {most} dB at five sizes" in prose
    lpips = [-mean("lpips_squeeze", key) for key in sizes]
    least, most = (said(value, 3).lstrip("+") for value in (min(lpips), max(lpips)))
    assert f"LPIPS by {least} to {most}" in prose
    assert f"LPIPS falls by {least} to {most}" in prose
    slope = np.polyfit(np.log2([size for size, _ in sizes]), lpips, 1)[0]
    assert f"by {said(slope, 3).lstrip('+')} more with each doubling" in prose
    assert abs(mean("lpips_squeeze", lengths[0])) < 0.0005
    for scene in scenes.values():
        for metric in ("lpips_squeeze", "psnr"):
            assert np.ptp(np.sign(by(scene["split"], metric, sizes[1], sizes[-1]))) == 0
    for metric, sure in (("psnr", 5), ("lpips_squeeze", 3)):  # as the table has it in bold
        steps = scripts.trends.found("scale_bridge", "longaxis", "absgrad", "scene.max_size", metric).steps
        assert sum(step.difference.interval.low * step.difference.interval.high > 0 for step in steps) == sure
    assert "the intervals of PSNR leave zero at all five, those of LPIPS at three" in prose
