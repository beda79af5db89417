"""COLMAP models of a few cameras, and a digest of written models."""

import hashlib

import numpy as np
import pycolmap


def camera_at(center, rotation=None):
    """The pose of a camera; without a rotation it looks along +z, with y downwards."""
    turn = np.eye(3) if rotation is None else rotation
    return pycolmap.Rigid3d(np.column_stack([turn, -turn @ np.asarray(center)]))


def model_with(poses, keypoints=0, camera=None):
    """A model of images with ids from 1 and one camera, by default of 100 x 80 px, f = 100 px.

    ``keypoints`` are the keypoints [K, 2] of each image, or their number.
    """
    model = pycolmap.Reconstruction()
    plain = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 100.0, 100, 80)
    model.add_camera_with_trivial_rig(camera or plain)
    for number, (name, pose) in enumerate(poses.items(), start=1):
        seen = np.zeros((keypoints, 2)) if isinstance(keypoints, int) else keypoints[name]
        image = pycolmap.Image(name=name, keypoints=seen, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    return model


def add_point(model, position, color=(10, 20, 30), seen_by=None):
    """Add a point; ``seen_by`` maps the ids of images to the indices of their keypoints."""
    elements = [pycolmap.TrackElement(*item) for item in (seen_by or {}).items()]
    place = np.asarray(position, dtype=float)
    model.add_point3D(place, pycolmap.Track(elements), np.array(color, dtype=np.uint8))


def digest(model):
    """The sha256 of all files of a model together."""
    files = sorted(model.glob("*.bin"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
