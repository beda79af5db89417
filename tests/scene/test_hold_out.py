"""Which views each `scene.split` holds out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsbench.errors import InputError
from gsbench.scene.hold_out import hold_out
from gsbench.scene.options import SceneConfig, SplitRule
from tests.helpers import refusal
from tests.scene.captures import read_colmap, read_photos
from tests.scene.tables import TABLES
from tests.scene.test_sectors import ring

NAMES = [f"{k:02d}.png" for k in range(24)]


CAMERAS = dict(zip(NAMES, ring([15.0 * k for k in range(24)]), strict=True))


def divided(names=NAMES, lists=(None, None), **rule):
    return hold_out(names, SplitRule(**rule), lists, CAMERAS)


def test_every_eighth_name_is_held_out_by_default():
    assert divided()[1:] == (["00.png", "08.png", "16.png"], "every 8th image")


def test_sectors_are_contiguous_and_follow_each_other_around_the_scene():
    parts = [divided(split="sector", sectors=4, sector=part)[1] for part in range(4)]
    assert parts[0] == NAMES[:6]
    assert [name for part in parts for name in part] == NAMES
    assert "part 0 of 4 by azimuth" in divided(split="sector", sectors=4)[2]
    with refusal(r"scene\.sectors=8 are more than the 5 images"):
        divided(NAMES[:5], split="sector")


@given(st.integers(9, 24), st.integers(2, 8), st.integers(0, 1))
def test_matched_splits_leave_equally_many_views(count, sectors, sector):
    rule = {"match_views": True, "sectors": sectors, "sector": sector}
    spread, part = (divided(NAMES[:count], split=kind, **rule) for kind in ("every_nth", "sector"))
    assert len(spread[0]) == len(part[0]) == count - count // sectors
    for train, test, _ in (spread, part):
        assert sorted(train + test) == NAMES[:count]
    steps = np.diff([NAMES.index(name) for name in spread[1]])
    assert len(steps) == 0 or steps.max() - steps.min() <= 1, "spread evenly"


@given(st.data())
def test_no_split_is_empty_or_trains_on_a_test_view(data):
    names = NAMES[: data.draw(st.integers(3, 8), "number of photographs")]
    sectors = data.draw(st.integers(2, 10), "sectors")
    rule = {
        "split": data.draw(st.sampled_from(["every_nth", "sector", "list"])),
        "test_every": data.draw(st.integers(2, 30), "test_every"),
        "sectors": sectors,
        "sector": data.draw(st.integers(0, sectors - 1), "sector"),
        "match_views": data.draw(st.booleans(), "match_views"),
        "validation": data.draw(st.booleans(), "validation"),
    }
    some = st.none() | st.lists(st.sampled_from(names), unique=True)
    lists = (data.draw(some), data.draw(some)) if rule["split"] == "list" else (None, None)
    try:
        train, test, _ = divided(names, lists, **rule)
    except InputError:
        return
    assert train
    assert test
    assert not set(train) & set(test)
    assert {*train, *test} <= set(names)


@pytest.mark.parametrize("split", ["every_nth", "sector"])
def test_validation_drops_the_test_views_and_divides_the_rest_by_the_same_rule(split):
    rule = {"split": split, "sectors": 4, "test_every": 4}
    away = divided(**rule)[1]
    train, test, description = divided(**rule, validation=True)
    assert f"the {len(away)} test views (" in description
    assert description.endswith("put away unseen")
    assert sorted(train + test + away) == NAMES
    if split == "sector":  # the sector next to the one that was put away
        assert test == NAMES[6:10]


def test_validation_of_lists_takes_every_nth_of_the_training_list():
    rule = {"split": "list", "validation": True, "test_every": 5}
    train, test, description = divided(lists=(NAMES[4:], NAMES[:4]), **rule)
    assert (test, sorted(train + test)) == (NAMES[4::5], NAMES[4:])
    assert "the 4 test views (by lists) put away unseen" in description


def test_a_view_dropped_by_validation_is_not_in_the_capture(make_scene):
    root = make_scene(names=NAMES[:9])
    rules = [{"test_every": 3, "validation": judged} for judged in (False, True)]
    plain, judged = (read_colmap(root, **rule) for rule in rules)
    assert plain.test_names == ("00.png", "03.png", "06.png")
    assert judged.image_names == tuple(name for name in NAMES[:9] if name not in plain.test_names)
    assert judged.test_names == ("01.png", "05.png")
    (root / "images" / "00.png").write_bytes((root / "images" / "01.png").read_bytes())
    other, same = (read_colmap(root, **rule) for rule in rules)
    assert same.fingerprint == judged.fingerprint
    assert other.fingerprint != plain.fingerprint


def test_sectors_of_a_folder_use_its_cameras_under_other_file_names(make_scene):
    root = make_scene(names=NAMES[:8])
    for name in NAMES[:8]:
        (root / "images" / name).rename(root / "images" / f"{name[:2]}.jpg")
    capture = read_colmap(root, split="sector", sectors=4, sector=3)
    assert capture.test_names == ("06.jpg", "07.jpg")
    assert "one direction" in capture.held_out


def test_lists_of_nerfbaselines_are_found_by_their_names(make_scene):
    root = make_scene(names=NAMES[:8])
    with refusal(r"neither train_list\.txt nor test_list\.txt"):
        read_colmap(root, split="list")
    (root / "train_list.txt").write_text("\n".join(NAMES[2:7]) + "\n")
    (root / "test_list.txt").write_text("\n".join(NAMES[:2]))
    for read in (read_colmap, read_photos):
        capture = read(root, split="list")
        assert capture.test_names == tuple(NAMES[:2])
        assert capture.train_names == tuple(NAMES[2:7])
    assert read_colmap(root).test_names == ("00.png",), "lists that nobody named hold out nothing"


@pytest.mark.parametrize("settings, message", TABLES["settings that contradict each other"])
def test_settings_that_contradict_each_other_are_refused(settings, message):
    with refusal(message):
        SceneConfig(**({"name": "a", "kind": "colmap", "path": "/a"} | settings))


@pytest.mark.parametrize("kind, changes", TABLES["settings that are not read"])
def test_a_setting_that_the_kind_of_scene_does_not_read_is_refused(kind, changes):
    path = None if kind == "courtyard" else "/a"
    (key,) = changes
    with refusal(rf"scene.{key}=.* is not read by scene.kind={kind}, only"):
        SceneConfig(name="a", kind=kind, path=path, **changes)


@pytest.mark.parametrize("settings, said", TABLES["paths and sizes refused"])
def test_the_courtyard_alone_has_no_path_and_views_have_a_least_size(settings, said):
    with refusal(said):
        SceneConfig(name="a", **settings)
