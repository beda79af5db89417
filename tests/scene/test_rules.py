"""The table of rules: the limits of each, and what is logged, refused, accepted and recorded."""

from dataclasses import replace
from types import SimpleNamespace as Facts

import numpy as np
import pytest
from PIL import Image

from gsbench.config.compose import compose_one
from gsbench.runs.code import config_hash
from gsbench.runs.configuration import arm_hash
from gsbench.runs.trial_record import TwinViews
from gsbench.scene import rules
from gsbench.scene.options import SceneConfig
from gsbench.scene.rules import BY_ID, RULES, Finding, Rule, check_accept, inspect
from gsbench.scene.types import Camera, Scene, View
from gsbench.verbs.machine import doctor
from tests.helpers import refusal
from tests.scene.captures import loaded, read_colmap, read_photos
from tests.scene.tables import TABLES


def camera(place=0.0, **changes):
    values = {"width": 40, "height": 32, "fx": 40.0, "fy": 40.0, "cx": 20.0, "cy": 16.0} | changes
    return Camera(**values, rotation=np.eye(3), translation=np.array([-place, 0.0, 0.0]))


def views(places=(-1.0, 0.0, 1.0, 2.0), level=200, **changes):
    image = np.full((32, 40, 3), level, np.uint8)
    return tuple(View(f"{n}.png", camera(x, **changes), image) for n, x in enumerate(places))


def scene(left_out={}, near={}, **changes):  # noqa: B006 - nobody changes them
    twins = TwinViews(left_out=left_out, near=near)
    return Scene("toy", views(**changes), views((0.5,)), twins=twins)


# id: a subject that is just fine, one that is not, what is said of it
ROWS = {
    "panorama": (
        Facts(panoramas=[]),
        Facts(panoramas=["a.jpg"]),
        "1 photograph declared as panoramas",
    ),
    "estimated-field-of-view": (
        Facts(fields_of_view=[Finding(150.0)]),
        Facts(fields_of_view=[Finding(151.0, (), {"focal": 13.0})]),
        r"focal length 13 px \(field of view 151 degrees\) is implausible",
    ),
    **TABLES["rules"],
}


def subject(rule, facts):
    """What the rule judges, from the facts of a table's row."""
    if not isinstance(facts, dict):
        return facts
    if rule.stage == "scene":
        return scene(**facts)
    if not rule.measure:
        return {rule.id: [Finding(facts["value"], ("a.png",), facts)]}
    return Facts(**facts)


def test_each_rule_has_its_row_here_and_an_id_of_its_own():
    assert sorted(rule.id for rule in RULES) == sorted(ROWS)


@pytest.mark.parametrize("name", ROWS)
def test_a_rule_is_silent_up_to_its_limit_and_names_what_is_beyond(name):
    fine, odd, said = ROWS[name]
    rule = BY_ID[name]
    assert rule.judge(subject(rule, fine)) is None
    judged = rule.judge(subject(rule, odd))
    with refusal(said):
        raise rules.InputError(judged.line)
    assert judged.refused is (rule.usable != rules.ANY)


RULE = Rule("odd", "read", "{value:g} of {names:few}", "take {low}", "", 0, 1, 2)


@pytest.fixture
def table(monkeypatch):
    monkeypatch.setattr(rules, "RULES", (RULE, replace(RULE, id="hard", stage="file", fixed=True)))
    monkeypatch.setattr(rules, "BY_ID", {rule.id: rule for rule in rules.RULES})


def odd(*values):
    return {"odd": [Finding(number, [f"{number:g}.png"], {"low": "less"}) for number in values]}


def test_what_is_odd_is_one_line_with_the_worst_value_and_all_names(table, caplog):
    assert inspect("read", odd(0, 1), "here") == ()
    assert not caplog.records
    (found,) = inspect("read", odd(1, 1.5, 2), "here")
    assert found.to_json() == {
        "rule": "odd",
        "line": "2 of 1.5.png, 2.png: take less",
        "value": 2.0,
    }
    assert caplog.messages == ["here: 2 of 1.5.png, 2.png: take less"]


@pytest.mark.parametrize("number", [3.0, float("nan"), float("inf")])
def test_what_is_not_usable_is_refused_unless_its_rule_is_accepted(table, caplog, number):
    with refusal(rf"^here: .* of {number:g}.png: take less \(or scene.accept=\[odd\]\)$"):
        inspect("read", odd(number), "here")
    (found,) = inspect("read", odd(number), "here", accept=("odd",))
    assert found.refused
    assert found.to_json()["refused"]
    assert caplog.messages[-1].endswith("(accepted: odd)")
    with refusal("take less$"):  # what was accepted when it was stored is judged again
        rules.settle([replace(found, rule="hard")], "here", accept=("odd",))


XMP = b'<rdf:Description GPano:ProjectionType="equirectangular"/>'


@pytest.mark.parametrize("size, refused", [((40, 20), True), ((40, 30), False)])
def test_panoramas_are_refused_unless_they_are_accepted(tmp_path, size, refused):
    for number in range(4):
        picture = Image.new("RGB", size, (60 * number, 0, 0))
        picture.save(tmp_path / f"{number}.jpg", xmp=XMP)
    with refusal(r"4 photographs declared as panoramas .*accept=\[panorama\]" if refused else None):
        read_photos(tmp_path)
    capture = read_photos(tmp_path, accept=["panorama"])
    assert [(odd.rule, odd.refused) for odd in capture.oddities] == [("panorama", True)] * refused
    with refusal("scene.accept=panoramas is no rule: .*did you mean panorama"):
        SceneConfig(name="toy", kind="photos", path="/x", accept=["panoramas"])


def test_prepared_views_of_an_accepted_lens_are_judged_again(make_scene, tmp_path):
    root = make_scene(model="SIMPLE_RADIAL", params=[30, 20, 15, -0.5])
    plain, accepting = (read_colmap(root, accept=accept) for accept in ([], ["lens-turns-back"]))
    scene = loaded(accepting, tmp_path)
    again = loaded(accepting, tmp_path)
    assert [odd.refused for odd in again.oddities if odd.rule == "lens-turns-back"] == [True]
    assert again.oddities == scene.oddities
    with refusal("turns back inside the picture"):
        loaded(plain, tmp_path)


def test_what_is_accepted_changes_no_hash_of_a_trial():
    plain, accepting = (
        compose_one(["scene=courtyard", *words]).values
        for words in ([], ["scene.accept=[lens-turns-back]"])
    )
    assert config_hash(plain) == config_hash(accepting)
    assert arm_hash(plain) == arm_hash(accepting)


@pytest.mark.parametrize("kind, odd", [("photos", "copies"), ("colmap", "copies, near-twins")])
def test_doctor_names_the_rules_that_say_something_of_a_scene(
    kind, odd, make_scene, tmp_path, capsys, caplog
):
    """Near twins are seen in views, which need cameras."""
    root = make_scene()
    first, second, third = sorted((root / "images").iterdir())[:3]
    second.write_bytes(first.read_bytes())
    with Image.open(first) as picture:
        Image.fromarray(np.asarray(picture) // 2).save(third)
    words = [f"scene={kind}", f"scene.path={root}", f"runs={tmp_path / 'runs'}"]
    assert doctor(words, tmp_path) == 0
    said = "5 photographs, 1 for testing (every 8th image)"
    assert capsys.readouterr().out == f"note  scene        {said}; odd: {odd}\n"
    assert "1 photograph left out, with the name or content of another" in caplog.text


def test_only_known_rules_that_may_be_broken_can_be_accepted():
    check_accept(["lens-turns-back", "panorama"])
    with refusal(r"scene.accept=lens is no rule: panorama and lens-turns-back can be accepted"):
        check_accept(["lens"])
    with refusal("scene.accept=too-few-images: this rule cannot be accepted"):
        check_accept(["too-few-images"])
