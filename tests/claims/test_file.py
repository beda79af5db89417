"""Files of claims: those that ship, and one line for every kind of bad input."""

import copy
import dataclasses
import re

import pytest
import yaml

from gsbench.claims.file import Claim, parse_claims, read_claims
from tests.conftest import ROOT
from tests.helpers import refusal

SHIPPED = sorted((ROOT / "conf/claims").glob("*.yaml"))
CLAIM = {
    "id": "lpips",
    "says": "it is better",
    "where": "abstract",
    "baseline": "adc",
    "arm": "volumetric",
    "metric": "lpips_squeeze",
    "direction": "lower",
    "least": 0.005,
    "refuted_if": "it is not",
}
GOOD = {
    "name": "check_it",
    "paper": "A paper",
    "seeds": 4,
    "settings": {"scene.max_size": 160, "eval.lpips": ["squeeze"]},
    "scenes": {"courtyard": None, "own": {"scene": "photos", "scene.path": "${oc.env:HOME}/own"}},
    "arms": {"adc": {}, "volumetric": {"densify": "volumetric"}},
    "claims": [CLAIM],
}


GONE = object()


def changed(place, to):
    """The good file with another value at a place such as ``claims.0.arm``, or without it."""
    content = inner = copy.deepcopy(GOOD)
    *keys, last = place.split(".", 2)
    for key in keys:
        inner = inner[int(key) if key.isdecimal() else key]
    last = int(last) if last.isdecimal() else last
    if to is GONE:
        del inner[last]
    else:
        inner[last] = to
    return content


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_files_that_ship_are_sound(path):
    file = read_claims(path)
    assert file.size
    assert len(file.claims) >= 4
    assert any(claim.not_testable for claim in file.claims)


def test_settings_of_a_trial_are_words_of_a_command_line():
    file = parse_claims(
        changed("claims.0.budget", {"densify.max_gaussians": 15000, "densify.cap": None})
    )
    assert file.words(file.claims[0], "own", "adc") == [
        "scene.max_size=160",
        "eval.lpips=[squeeze]",
        "scene=photos",
        "scene.path=${oc.env:HOME}/own",
        "densify=adc",
        "densify.max_gaussians=15000",
        "densify.cap=null",
    ]
    assert file.words(file.claims[0], "courtyard", "volumetric")[2] == "scene=courtyard"


def test_settings_of_a_claim_override_those_of_arms_and_of_the_file():
    content = changed("settings", {"densify.max_gaussians": 1, "scene.max_size": 160})
    content["arms"]["adc"] = {"densify": "adc", "densify.max_gaussians": 2}
    content["claims"][0]["budget"] = {"densify.max_gaussians": 3}
    words = (file := parse_claims(content)).words(file.claims[0], "courtyard", "adc")
    assert [word for word in words if "max_gaussians" in word] == ["densify.max_gaussians=3"]


def test_the_direction_of_a_claim_is_the_sign_of_its_question():
    def sign(direction):
        file = parse_claims(changed("claims.0.direction", direction))
        return file.question(
            file.claims[0], {"courtyard": ("garden/sfm-adc/0a", "garden/sfm-volumetric/0b")}
        ).sign

    assert [sign(direction) for direction in ("higher", "same", "lower")] == [1, 0, -1]


def test_the_question_does_not_depend_on_the_wording_of_the_claim():
    file = parse_claims(GOOD)
    keys = ("garden/sfm-adc/0a", "garden/sfm-volumetric/0b")
    question = file.question(file.claims[0], {"courtyard": keys})
    asked = question.metric, question.sign, question.least, question.relative
    assert asked == ("lpips_squeeze", -1, 0.005, False)
    assert (str(question.baseline), question.seeds) == ("adc[densify=adc]", (0, 1, 2, 3))
    assert question.planned == dict.fromkeys(keys, question.seeds)
    other = parse_claims(changed("claims.0.says", "in other words"))
    assert other.question(other.claims[0], {"courtyard": keys}) == question


def test_the_least_effect_is_a_difference_or_a_percentage():
    absolute = parse_claims(GOOD).claims[0].effect
    relative = parse_claims(changed("claims.0.least", "10%")).claims[0].effect
    assert (absolute.size, str(absolute)) == (0.005, "0.005")
    assert (relative.size, str(relative)) == (pytest.approx(0.1), "10 %")


BAD = [
    ("claims.0.refuted_if", GONE, "claims.1..refuted_if is not given"),
    ("seeds", GONE, "seeds is not given"),
    ("claims", GONE, "at least one claim|claims is not given"),
    ("claims", [CLAIM, CLAIM | {"metric": "psnr"}], "each its own"),
    ("claims.0.arm", "volumetrik", "did you mean volumetric"),
    ("claims.0.baseline", "adcc", "baseline 'adcc'.*did you mean adc"),
    ("claims.0.metric", "lpips_squeze", "did you mean lpips_squeeze"),
    ("claims.0.scenes", ["courtyrad"], "did you mean courtyard"),
    ("claims.0.scenes", ["own", "own"], "is listed twice"),
    ("claims.0.arm", "adc", "compared with itself"),
    ("claims.0.least", 0, "above 0"),
    ("claims.0.least", "0%", "above 0"),
    ("claims.0.least", -0.1, "above 0"),
    ("claims.0.least", "much", "above 0"),
    ("claims.0.least", "inf", "above 0"),
    ("claims.0.metric", "gaussians", "such as 10%"),
    ("claims.0", CLAIM | {"metric": "ssim", "least": 1}, "more than ssim can differ by"),
    ("claims.0.direction", "lowre", "'higher', 'lower' or 'same'"),
    ("claims.0.metrics", "psnr", "did you mean metric"),
    ("clams", [], "did you mean claims"),
    ("seeds", 1, r"in \[2, 1000\]"),
    ("seeds", 10**9, r"in \[2, 1000\]"),
    ("claims", [], "at least one claim"),
    ("claims.0", "it is better", "must be a mapping"),
    ("claims.0.says", "  ", "says must be a text that is not empty"),
    ("scenes", {}, "at least one"),
    ("scenes.own", "photos", "must be a mapping of settings"),
    ("settings", {"scene": {"max_size": 160}}, "with dots"),
    ("claims.0.budget", {"densify": {"cap": "hard"}}, "with dots"),
    ("settings", {"seed": 3}, "set by the plan"),
    ("arms.adc", {"name": "x"}, "set by the plan"),
    ("settings", {"eval.primary": "psnr"}, "set by the plan"),
    ("settings", {"scene max": 160}, "is not a setting"),
    ("error_rate", 1.0, "error_rate"),
    ("name", "../other", "letters, digits"),
]


@pytest.mark.parametrize("place, value, message", BAD)
def test_bad_input_is_refused_in_one_line(place, value, message):
    with refusal(message):
        parse_claims(changed(place, value))


@pytest.mark.parametrize("content", [[], None])
def test_what_is_no_mapping_is_refused(content):
    with refusal("must be a mapping"):
        parse_claims(content)


def test_a_users_own_metric_needs_its_class():
    content = changed("claims.0.metric", "sharpness")
    with refusal(r"eval\.extra\.sharpness"):
        parse_claims(content)
    content["settings"]["eval.extra.sharpness._target_"] = "mine.Sharpness"
    assert parse_claims(content).claims[0].metric == "sharpness"


def test_the_file_that_the_document_shows_is_sound():
    page = (ROOT / "docs/claims.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```yaml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    file = parse_claims(yaml.safe_load(block))
    for entry in dataclasses.fields(Claim):
        assert f"`{entry.name}`" in page  # the table has every key
    assert [claim.id for claim in file.claims] == ["quality"]


def test_files_that_cannot_be_read_are_refused_in_one_line(tmp_path):
    path = tmp_path / "bad.yaml"
    for place in (path, tmp_path):
        with refusal("cannot be read"):
            read_claims(place)
    for text, message in (
        ("a: [", "not YAML"),
        ("name: a\nname: b\n", "is in it twice"),
        ("a: {b: [{c: 1, c: 2}]}", r"'c' is in it twice \(line 1\)"),
        ("", "mapping"),
        ("name: 2001-99-99", "not YAML"),
        ("name: 2001-01-01", "of type date"),
        ("[" * 20_000, "levels"),
        ("a: &a {b: 1}\nc: {<<: *a}", "merge key"),
        ("a: !!python/name:os.system x", "tag"),
    ):
        path.write_text(text)
        with refusal(message):
            read_claims(path)
    path.write_bytes(b"\xff\xfe\x00")
    with refusal(r"UTF-8|YAML"):
        read_claims(path)
