"""Checking keys of ``transforms.json`` that gsbench does not use: harmless, refused or unknown.

Sources: nerfstudio's page "Data conventions" and its reader; instant-ngp's page "Tips for training
NeRF models" and its loader (nerf_loader.cu), whose keys most exporters write (Metashape, Polycam
and others).
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.scene.options import Backdrop
from gsbench.words import counted

log = logging.getLogger(__name__)

# Keys that change no photograph, camera or initial point: how another program frames, thins or
# samples the scene. The box, axes and scale in which instant-ngp and nerfstudio train; gsbench
# keeps the coordinates of the file.
BOX = ("aabb", "aabb_scale", "render_aabb", "near", "far")
AXES = ("scale", "offset", "up", "from_na", "orientation_override")
# Data besides photographs, which gsbench does not train on.
DEPTH = (
    "depth_path",
    "integer_depth_scale",
    "enable_depth_loading",
    "depth_unit_scale_factor",
)
OTHER_DATA = ("enable_ray_loading", "normal_file_path", "envmap")
# `black_transparent` makes black pixels transparent: harmless where these are blended over black.
TRAINING = ("importance_sampling", "n_extra_learnable_dims", "black_transparent")
NOTES = (
    "sharpness",
    "blur_score",
    "colmap_im_id",
    "camera_id",
    "rotation",
    "timestamp",
    "camera_label",
)
HARMLESS = frozenset((*BOX, *AXES, *DEPTH, *OTHER_DATA, *TRAINING, *NOTES))
# Keys that change pixels, cameras or the choice of frames, and why a file that uses them is
# refused.
REFUSED = {
    "rolling_shutter": "photographs with a rolling shutter have no single pose",
    "transform_matrix_start": "a frame that moves has no single pose",
    "transform_matrix_end": "a frame that moves has no single pose",
    **dict.fromkeys(
        ("ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"),
        "the F-theta lens is not known",
    ),
    "latlong": "a panorama is no pinhole image",
    "equirectangular": "a panorama is no pinhole image",
    **dict.fromkeys(("s1", "s2", "s3", "s4"), "thin-prism distortion is not read"),
    "distortion_params": "write its numbers as k1, k2, k3, k4, p1 and p2",
    "normal_mts_args": "Mitsuba's axes are not known",
    "n_frames": "it cuts the list of frames: shorten the list itself",
    "sharpness_discard_threshold": "it leaves out frames: shorten the list itself",
    "sharpen": "it changes the photographs: sharpen the files themselves",
    "fix_premult": "it changes the photographs: save them without premultiplied alpha",
    "white_transparent": "it makes white pixels transparent: save the files so",
    "time": "a scene that moves cannot be trained as one that stands still",
}
BLACK_BECOMES_WHITE = {
    "black_transparent": "it makes black pixels transparent, which scene.transparent=white "
    "makes white: save the files so"
}


def check_keys(
    path: Path,
    document: Any,
    file_keys: Collection[str],
    frame_keys: Collection[str],
    backdrop: Backdrop,
) -> None:
    """Check the keys of a file that gsbench does not use.

    ``file_keys`` are the used keys of the file, ``frame_keys`` those of a frame; ``backdrop`` is
    the colour under transparent pixels. Raises InputError for a key of `REFUSED` whose value has an
    effect (`says_something`). Logs one line that names unknown keys.
    """
    refused = REFUSED if backdrop == "black" else REFUSED | BLACK_BECOMES_WHITE
    unknown: set[str] = set()
    records = [("", document, file_keys)]
    for number, frame in enumerate(document["frames"]):
        records.append((f" (frame {number})", frame, frame_keys))
    for place, record, used in records:
        for key, value in record.items():
            if key in refused and says_something(key, value):
                raise InputError(f"{path}: {key}{place}: {refused[key]}")
            if key not in used and key not in HARMLESS and key not in REFUSED:
                unknown.add(key)
    if unknown:
        log.warning(
            "%s: %s not known and not used: %s",
            path,
            _are(len(unknown)),
            ", ".join(sorted(unknown)),
        )


def says_something(key: str, value: Any) -> bool:
    """Return whether a value has an effect: it is not null, false, empty or a list of zeros.

    A matrix has an effect whatever its numbers are.
    """
    if key.startswith("transform_matrix"):
        return value is not None
    if isinstance(value, list):
        return any(says_something(key, item) for item in value)
    return bool(value)


def _are(count: int) -> str:
    return f"{counted(count, 'key')} {'is' if count == 1 else 'are'}"
