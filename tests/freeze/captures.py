"""What gsbench reads of a corpus of captures: compared before and after a change of the readers.

    python -m tests.freeze.captures CORPUS [--write]

Each folder of CORPUS has ``case.json`` (the kind, and settings of the scene) and ``in``, the
capture. The outcome of each is its fingerprint, names, split and cameras, or "refused".
"""

import gzip
import hashlib
import json
import logging
import sys
import tempfile
from pathlib import Path

import numpy as np

from gsbench.errors import InputError
from gsbench.pipeline.steps.scene import CaptureSource
from gsbench.scene.colmap import plain_camera, read_model
from gsbench.scene.options import SceneConfig

FILE = Path(__file__).with_name("captures.json.gz")


def cameras_of(model):
    """A digest of names, cameras and poses, rounded to 1e-9, and of the points."""
    lines = []
    for _, image in sorted(model.images.items()):
        camera = plain_camera(model.cameras[image.camera_id])
        pose = image.cam_from_world().matrix().ravel() if image.has_pose else np.zeros(12)
        numbers = np.round(np.concatenate([camera.params, pose]), 9) + 0.0
        numbers = [f"{number:.9g}" for number in numbers]
        lines.append([image.name, camera.name, camera.width, camera.height, *numbers])
    points = [np.round(point.xyz, 9) + 0.0 for _, point in sorted(model.points3D.items())]
    colors = [point.color.tolist() for _, point in sorted(model.points3D.items())]
    lines.append([[f"{value:.9g}" for point in points for value in point], colors])
    return len(model.images), hashlib.sha256(json.dumps(lines).encode()).hexdigest()[:16]


def outcome(case, folder):
    """What is read of one case of the corpus."""
    if case["kind"] == "model":
        try:
            return {"model": cameras_of(read_model(folder))}
        except InputError as error:
            return {"refused": str(error)}
    settings = {
        key: case[key] for key in ("images", "sparse", "masks", "max_images") if key in case
    }
    settings |= case.get("split", {})
    kind = "transforms" if case["kind"] == "cameras" else case["kind"]
    if case["kind"] == "cameras":
        settings["transparent"] = case["backdrop"]
    for key in ("images", "sparse", "masks", "train_list", "test_list"):
        if settings.get(key):
            settings[key] = settings[key].replace(case["root"], str(folder))
    try:
        source = CaptureSource(SceneConfig(kind=kind, path=str(folder), name="case", **settings))
        with tempfile.TemporaryDirectory() as made:
            step = source.step
            if step is not None:
                step.build(Path(made))
            capture = source.read(Path(made) if step is not None else None)
            return {
                "fingerprint": capture.fingerprint,
                "images": capture.images.relative_to(folder).as_posix(),
                "names": list(capture.image_names),
                "test": list(capture.test_names),
                "held_out": capture.held_out,
                "masks": {
                    name: file.relative_to(folder).as_posix()
                    for name, file in sorted(capture.masks.items())
                },
                "left_out": dict(capture.left_out),
                "advised": repr(capture.advised_normalization),
                "model": None if capture.model is None else cameras_of(read_model(capture.model)),
            }
    except InputError as error:
        return {"refused": str(error).replace(str(folder), "ROOT")}


def read_corpus(corpus):
    """The outcome of each case by its key."""
    found = {}
    for file in sorted(corpus.glob("*/case.json")):
        case = json.loads(file.read_text())
        try:
            found[file.parent.name] = outcome(case, file.parent / "in")
        except Exception as error:  # noqa: BLE001 - any of them is an outcome
            found[file.parent.name] = {"error": f"{type(error).__name__}: {error}"[:200]}
        found[file.parent.name]["what"] = f"{case['kind']} {case['test']}"
    return found


def compact(outcomes):
    """The outcomes as digests: texts of refusals may change, and are left out."""
    small = {}
    for key, found in outcomes.items():
        if "refused" in found or "error" in found:
            small[key] = "refused" if "refused" in found else "error"
        else:
            text = json.dumps(found, sort_keys=True).encode()
            small[key] = hashlib.sha256(text).hexdigest()[:20]
    return small


def main(words):
    corpus = Path(words[0])
    logging.disable()
    found = read_corpus(corpus)
    if "--write" in words:
        FILE.write_bytes(gzip.compress(json.dumps(compact(found)).encode(), mtime=0))
        (corpus / "outcomes.json").write_text(json.dumps(found, indent=1, sort_keys=True))
        print(f"{len(found)} captures")
        return
    before, now = json.loads(gzip.decompress(FILE.read_bytes())), compact(found)
    file = corpus / "outcomes.json"
    full = json.loads(file.read_text()) if file.is_file() else {}
    differing = [key for key in before if now.get(key) != before[key]]
    for key in differing:
        old, new = full.get(key, {}), found.get(key, {})
        parts = {name for name in {*old, *new} if old.get(name) != new.get(name)}
        print(key, new.get("what"))
        for name in sorted(parts):
            print(f"    {name}: {str(old.get(name))[:300]}\n      -> {str(new.get(name))[:300]}")
    print(f"{len(differing)} of {len(before)} captures differ")


if __name__ == "__main__":
    main(sys.argv[1:])
