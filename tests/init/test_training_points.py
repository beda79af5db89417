"""Points that do not depend on test photographs (init.points_from=train)."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from gsbench.init import MODEL_FOLDER, Dataset, Dim, Sfm
from gsbench.init.base import REPORT_FILE
from gsbench.runs.keys import options_of
from gsbench.scene.colmap import read_model
from tests.helpers import read_json
from tests.init.models import add_point


@pytest.fixture(scope="module")
def with_points(courtyard, tmp_path_factory):
    """The courtyard with points of all views, and image ids in the reverse order of names."""
    folder = tmp_path_factory.mktemp("points")
    Sfm(threads=1, first_octave=0, max_num_features=1500).run(courtyard, folder)
    model, turned = read_model(folder / MODEL_FOLDER), pycolmap.Reconstruction()
    camera = next(iter(model.cameras.values()))
    turned.add_camera_with_trivial_rig(camera)
    ids = {image_id: 100 - image_id for image_id in model.images}
    for image_id, image in model.images.items():
        points = np.array([point.xy for point in image.points2D])
        copy = pycolmap.Image(
            name=image.name, keypoints=points, camera_id=camera.camera_id, image_id=ids[image_id]
        )
        turned.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        seen_by = {ids[e.image_id]: e.point2D_idx for e in point.track.elements}
        add_point(turned, point.xyz, point.color, seen_by)
    (folder / "turned").mkdir()
    turned.write_binary(folder / "turned")
    return replace(courtyard, model=folder / "turned")


def seen_by(model):
    return [
        {model.images[element.image_id].name for element in point.track.elements}
        for point in model.points3D.values()
    ]


def test_points_and_colours_come_from_training_photographs(with_points, tmp_path):
    """Each colour is the mean of the photographs at the observations, interpolated here again."""
    total = read_model(with_points.model).num_points3D()
    points = Dataset(points_from="train").run(with_points, tmp_path).training_points
    model = read_model(tmp_path / MODEL_FOLDER)
    kept = model.num_points3D()
    assert (points.choice, points.kept, points.total) == ("train", kept, total)
    assert kept < total
    assert points.removed == pytest.approx(1 - kept / total)
    assert read_json(tmp_path / REPORT_FILE)["training_points"]["removed"] == points.removed
    assert not any(names & {*with_points.test_names} for names in seen_by(model))
    assert not (tmp_path / "work").exists()
    pictures = {
        name: np.asarray(Image.open(with_points.images / name)).astype(float)
        for name in with_points.image_names
    }
    for point in list(model.points3D.values())[::50]:
        samples = []
        for element in point.track.elements:
            image = model.images[element.image_id]
            x, y = image.points2D[element.point2D_idx].xy - 0.5
            column, row = int(np.floor(x)), int(np.floor(y))
            picture, dx, dy = pictures[image.name], x - np.floor(x), y - np.floor(y)
            samples.append(
                (1 - dy) * ((1 - dx) * picture[row, column] + dx * picture[row, column + 1])
                + dy * ((1 - dx) * picture[row + 1, column] + dx * picture[row + 1, column + 1])
            )
        assert_allclose(point.color, np.mean(samples, axis=0), atol=1.0)


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
