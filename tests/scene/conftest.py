"""Small COLMAP folders built with pycolmap and Pillow."""

import zlib  # noqa: F401  before pycolmap, see gsbench.scene.colmap

import numpy as np
import pycolmap
import pytest
from PIL import Image


def smooth_image(width, height, seed=0):
    """A smooth random picture, [H, W, 3] uint8."""
    small = np.random.default_rng(seed).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return np.asarray(Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC))


@pytest.fixture
def make_scene(tmp_path):
    """A function that writes ``root/images`` and ``root/sparse/0`` and returns the root."""

    def make(
        names=tuple(f"{k:02d}.png" for k in range(6)),
        size=(40, 30),
        camera_size=None,
        model="PINHOLE",
        params=None,
        text=False,
        sparse="sparse/0",
        root="scene",
    ):
        folder = tmp_path / root
        camera_size = camera_size or size
        camera = pycolmap.Camera.create_from_model_name(1, model, 50.0, *camera_size)
        if params is not None:
            camera.params = list(params)
        rec = pycolmap.Reconstruction()
        rec.add_camera_with_trivial_rig(camera)
        corners = np.array([[x, y, 5.0] for x in (-1, 0, 1) for y in (-1, 0, 1)], dtype=float)
        for k, name in enumerate(names):
            pose = np.column_stack([np.eye(3), [0.1 * k, 0.0, 0.0]])
            keypoints = np.array([camera.img_from_cam(point + pose[:, 3]) for point in corners])
            image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=k + 1)
            rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
            path = folder / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(smooth_image(*size, seed=k)).save(path)
        for j, corner in enumerate(corners):
            track = pycolmap.Track([pycolmap.TrackElement(k + 1, j) for k in range(len(names))])
            rec.add_point3D(corner, track, np.array([10 * j, 20, 30], dtype=np.uint8))
        (folder / sparse).mkdir(parents=True, exist_ok=True)
        (rec.write_text if text else rec.write_binary)(folder / sparse)
        return folder

    return make
