"""Points that do not depend on test photographs (init.points_from=train)."""

from dataclasses import replace

import pytest

from gsbench.init import MODEL_FOLDER, Dataset, Dim, Sfm
from gsbench.runs.keys import options_of
from gsbench.scene.colmap import read_model


def seen_by(model):
    return [
        {model.images[element.image_id].name for element in point.track.elements}
        for point in model.points3D.values()
    ]


@pytest.mark.slow
def test_estimated_cameras_keep_all_views_and_points_of_training_views(bare_photos, tmp_path):
    capture = replace(bare_photos, test_names=bare_photos.image_names[3:5])
    report = Sfm(points_from="train", threads=1).run(capture, tmp_path)
    model, test = read_model(tmp_path / MODEL_FOLDER), set(capture.test_names)
    assert report.num_registered == len(capture.image_names)
    assert not any(names & test for names in seen_by(model))
    assert report.training_points.kept == model.num_points3D() < report.training_points.total


def test_the_key_of_an_initialiser_contains_points_from():
    for made in (Sfm, Dim, Dataset):
        assert options_of("init", made())["points_from"] == "all"
        assert options_of("init", made(points_from="train"))["points_from"] == "train"
