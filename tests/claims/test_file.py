"""Files of claims: those that ship, and one line for every kind of bad input."""

import copy
import dataclasses
import re

import pytest
import yaml

from gsbench.claims.file import Claim, parse_claims, read_claims
from tests.conftest import ROOT
from tests.helpers import refusal

SHIPPED = sorted((ROOT / "conf" / "claims").glob("*.yaml"))
GOOD = {
    "name": "check_it",
    "paper": "A paper",
    "seeds": 4,
    "settings": {"scene.max_size": 160, "eval.lpips": ["squeeze"]},
    "scenes": {"courtyard": None, "own": {"scene": "photos", "scene.path": "${oc.env:HOME}/own"}},
    "arms": {"adc": {}, "volumetric": {"densify": "volumetric"}},
    "claims": [
        {
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
    ],
}


def changed(*path, to):
    """The good file with one value changed."""
    content = copy.deepcopy(GOOD)
    place = content
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = to
    return content


def without(*path):
    content = copy.deepcopy(GOOD)
    place = content
    for key in path[:-1]:
        place = place[key]
    del place[path[-1]]
    return content


def second_claim(**changes):
    content = copy.deepcopy(GOOD)
    content["claims"].append(content["claims"][0] | {"id": "other"} | changes)
    return content


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_the_files_that_ship_are_sound(path):
    file = read_claims(path)
    assert file.size
    assert len(file.claims) >= 4
    assert any(claim.not_testable for claim in file.claims)


def test_settings_of_a_trial_are_words_of_a_command_line():
    file = parse_claims(
        changed("claims", 0, "budget", to={"densify.max_gaussians": 15000, "densify.cap": None})
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
    content = changed("settings", to={"densify.max_gaussians": 1, "scene.max_size": 160})
    content["arms"]["adc"] = {"densify": "adc", "densify.max_gaussians": 2}
    content["claims"][0]["budget"] = {"densify.max_gaussians": 3}
    words = (file := parse_claims(content)).words(file.claims[0], "courtyard", "adc")
    assert [word for word in words if "max_gaussians" in word] == ["densify.max_gaussians=3"]


def test_the_direction_of_a_claim_is_the_sign_of_its_question():
    def sign(direction):
        file = parse_claims(changed("claims", 0, "direction", to=direction))
        return file.question(
            file.claims[0], {"courtyard": ("garden/sfm-adc/0a", "garden/sfm-volumetric/0b")}
        ).sign

    assert [sign(direction) for direction in ("higher", "same", "lower")] == [1, 0, -1]


def test_the_question_does_not_depend_on_the_wording_of_the_claim():
    file = parse_claims(GOOD)
    keys = ("garden/sfm-adc/0a", "garden/sfm-volumetric/0b")
    question = file.question(file.claims[0], {"courtyard": keys})
    assert (question.metric, question.sign, question.least, question.relative) == (
        "lpips_squeeze",
        -1,
        0.005,
        False,
    )
    assert (str(question.baseline), question.seeds) == (
        "adc[densify=adc]",
        tuple(range(file.seeds)),
    )
    assert question.planned == dict.fromkeys(keys, question.seeds)
    other = parse_claims(changed("claims", 0, "says", to="in other words"))
    assert other.question(other.claims[0], {"courtyard": keys}) == question


def test_the_least_effect_is_a_difference_or_a_percentage():
    absolute = parse_claims(GOOD).claims[0].effect
    relative = parse_claims(changed("claims", 0, "least", to="10%")).claims[0].effect
    assert (absolute.size, str(absolute)) == (0.005, "0.005")
    assert (relative.size, str(relative)) == (pytest.approx(0.1), "10 %")


BAD = [
    (
        "an unknown arm",
        lambda: changed("claims", 0, "arm", to="volumetrik"),
        "did you mean volumetric",
    ),
    (
        "an unknown baseline",
        lambda: changed("claims", 0, "baseline", to="adcc"),
        "baseline 'adcc'.*did you mean adc",
    ),
    (
        "an unknown metric",
        lambda: changed("claims", 0, "metric", to="lpips_squeze"),
        "did you mean lpips_squeeze",
    ),
    (
        "an unknown scene",
        lambda: changed("claims", 0, "scenes", to=["courtyrad"]),
        "did you mean courtyard",
    ),
    ("a scene twice", lambda: changed("claims", 0, "scenes", to=["own", "own"]), "is listed twice"),
    (
        "an arm against itself",
        lambda: changed("claims", 0, "arm", to="adc"),
        "compared with itself",
    ),
    ("zero width", lambda: changed("claims", 0, "least", to=0), "above 0"),
    ("zero percent", lambda: changed("claims", 0, "least", to="0%"), "above 0"),
    ("a negative width", lambda: changed("claims", 0, "least", to=-0.1), "above 0"),
    ("no number", lambda: changed("claims", 0, "least", to="much"), "above 0"),
    ("an infinite width", lambda: changed("claims", 0, "least", to="inf"), "above 0"),
    (
        "a count without percent",
        lambda: changed("claims", 0, "metric", to="gaussians"),
        "such as 10%",
    ),
    (
        "a width above the metric's range",
        lambda: changed("claims", 0, to=GOOD["claims"][0] | {"metric": "ssim", "least": 1}),
        "more than ssim can differ by",
    ),
    (
        "an unknown direction",
        lambda: changed("claims", 0, "direction", to="lowre"),
        "'higher', 'lower' or 'same'",
    ),
    ("an unknown key", lambda: changed("claims", 0, "metrics", to="psnr"), "did you mean metric"),
    ("an unknown key at the top", lambda: changed("clams", to=[]), "did you mean claims"),
    (
        "a key that is missing",
        lambda: without("claims", 0, "refuted_if"),
        "claims.1..refuted_if is not given",
    ),
    ("no seeds", lambda: without("seeds"), "seeds is not given"),
    ("one seed", lambda: changed("seeds", to=1), r"in \[2, 1000\]"),
    ("endless seeds", lambda: changed("seeds", to=10**9), r"in \[2, 1000\]"),
    ("no claims", lambda: changed("claims", to=[]), "at least one claim"),
    (
        "claims that are missing",
        lambda: without("claims"),
        "at least one claim|claims is not given",
    ),
    ("a claim that is text", lambda: changed("claims", 0, to="it is better"), "must be a mapping"),
    (
        "an empty sentence",
        lambda: changed("claims", 0, "says", to="  "),
        "says must be a text that is not empty",
    ),
    ("no scenes", lambda: changed("scenes", to={}), "at least one"),
    (
        "a scene that is text",
        lambda: changed("scenes", "own", to="photos"),
        "must be a mapping of settings",
    ),
    ("nested settings", lambda: changed("settings", to={"scene": {"max_size": 160}}), "with dots"),
    (
        "a nested budget",
        lambda: changed("claims", 0, "budget", to={"densify": {"cap": "hard"}}),
        "with dots",
    ),
    ("a seed of its own", lambda: changed("settings", to={"seed": 3}), "set by the plan"),
    ("a name of its own", lambda: changed("arms", "adc", to={"name": "x"}), "set by the plan"),
    (
        "a primary metric",
        lambda: changed("settings", to={"eval.primary": "psnr"}),
        "set by the plan",
    ),
    ("no setting", lambda: changed("settings", to={"scene max": 160}), "is not a setting"),
    ("an error rate of 1", lambda: changed("error_rate", to=1.0), "error_rate"),
    ("a list", lambda: [], "must be a mapping"),
    ("nothing", lambda: None, "must be a mapping"),
    ("a name that is a path", lambda: changed("name", to="../other"), "letters, digits"),
    ("one id twice", lambda: second_claim(id="lpips", metric="psnr"), "each its own"),
]


@pytest.mark.parametrize(
    "content, message", [case[1:] for case in BAD], ids=[case[0] for case in BAD]
)
def test_bad_input_is_refused_in_one_line(content, message):
    with refusal(message):
        parse_claims(content())


def test_a_users_own_metric_needs_its_class():
    content = changed("claims", 0, "metric", to="sharpness")
    with refusal(r"eval\.extra\.sharpness"):
        parse_claims(content)
    content["settings"]["eval.extra.sharpness._target_"] = "mine.Sharpness"
    assert parse_claims(content).claims[0].metric == "sharpness"


def test_the_file_that_the_document_shows_is_sound():
    page = (ROOT / "docs" / "claims.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```yaml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    file = parse_claims(yaml.safe_load(block))
    for entry in dataclasses.fields(Claim):
        assert f"`{entry.name}`" in page  # the table has every key
    assert [claim.id for claim in file.claims] == ["quality"]


def test_files_that_cannot_be_read_are_refused_in_one_line(tmp_path):
    with refusal("cannot be read"):
        read_claims(tmp_path / "none.yaml")
    with refusal("cannot be read"):
        read_claims(tmp_path)
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
        path = tmp_path / "bad.yaml"
        path.write_text(text)
        with refusal(message):
            read_claims(path)
    path.write_bytes(b"\xff\xfe\x00")
    with refusal(r"UTF-8|YAML"):
        read_claims(path)
