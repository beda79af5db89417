"""Read damaged models, PLY files, pictures and archives one by one.

It is a program of its own, so that a crash ends only this program.

    python -m tests.fuzz.models FOLDER FIRST COUNT

It prints how many cases were refused and how many were read. A case with any other end stops it;
its number is in ``FOLDER/current``.
"""

import sys
import zipfile
from pathlib import Path
from random import Random

import numpy as np
from PIL import Image

from gsbench.datasets.archive import DamagedMemberError, extract, open_archive, wanted_members
from gsbench.errors import InputError
from gsbench.gaussians.ply import read_ply, write_ply
from gsbench.scene.colmap import read_model
from gsbench.scene.images import image_size, lens_of, read_image
from tests.fuzz.corrupt import cases, corrupt
from tests.gaussians.helpers import random_gaussians

KINDS = ("colmap.bin", "colmap.txt", "ply", "picture", "zip")
PICTURES = ("a.jpg", "b.png", "c.png", "d.webp", "e.tif", "f.tif", "g.bmp", "h.png")
MEMBERS = {
    f"scene/images/{name}": bytes(range(256)) * size
    for name, size in (("a.jpg", 3), ("b.jpg", 1), ("c.jpg", 9))
}


def write_originals(folder):
    """Write a small model in both formats, a PLY file, pictures and archives."""
    import pycolmap

    options = pycolmap.SyntheticDatasetOptions()
    options.num_frames_per_rig, options.num_points3D = 4, 12
    model = pycolmap.synthesize_dataset(options)
    for kind in KINDS[:2]:
        (folder / kind).mkdir(parents=True, exist_ok=True)
    model.write_binary(folder / KINDS[0])
    model.write_text(folder / KINDS[1])
    write_ply(random_gaussians(5, seed=1), folder / "model.ply")
    rng = np.random.default_rng(0)
    rgb = Image.fromarray(rng.integers(0, 255, (9, 12, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    rgb.save(folder / "a.jpg", exif=exif)
    rgb.convert("P").save(folder / "c.png", transparency=3)
    rgb.save(folder / "e.tif", compression="tiff_lzw")
    for name in ("b.png", "d.webp", "g.bmp"):
        rgb.save(folder / name)
    for name in ("f.tif", "h.png"):
        Image.fromarray(rng.integers(0, 65535, (9, 12), dtype=np.uint16)).save(folder / name)
    for name, packed in (("stored.zip", zipfile.ZIP_STORED), ("packed.zip", zipfile.ZIP_DEFLATED)):
        with zipfile.ZipFile(folder / name, "w", packed) as archive:
            for member, content in MEMBERS.items():
                archive.writestr(member, content)


def run_case(originals, work, case):
    """Return whether a damaged file was refused; otherwise it was read as sensible values."""
    rng = Random(case)
    kind = KINDS[case % len(KINDS)]
    if kind in SINGLE_FILES:
        names, check = SINGLE_FILES[kind]
        target = work / rng.choice(names)
        target.write_bytes(corrupt((originals / target.name).read_bytes(), rng))
        return _refused(lambda: check(target))
    target = work / kind
    target.mkdir(exist_ok=True)
    files = sorted((originals / kind).iterdir())
    legacy = rng.random() < 0.5  # the three files of the older layout
    hurt = rng.choice([file for file in files if not legacy or file.stem not in ("rigs", "frames")])
    for file in target.iterdir():
        file.unlink()
    for file in files:
        if not (legacy and file.stem in ("rigs", "frames")):
            data = file.read_bytes()
            (target / file.name).write_bytes(corrupt(data, rng) if file == hurt else data)
    return _refused(lambda: _check_model(target))


def _check_model(folder):
    model = read_model(folder)
    poses = [image.cam_from_world().matrix() for image in model.images.values() if image.has_pose]
    points = [point.xyz for point in model.points3D.values()]
    assert all(np.isfinite(value).all() for value in (*poses, *points))
    assert all(
        min(camera.width, camera.height, camera.focal_length_x) > 0
        for camera in model.cameras.values()
    )


def _check_gaussians(path):
    gaussians = read_ply(path)
    assert len(gaussians) > 0
    assert all(np.isfinite(tensor.numpy()).all() for tensor in gaussians.tensors().values())


def _check_picture(path):
    width, height = image_size(path)
    assert lens_of(path)
    if width * height < 1 << 24:  # a larger one would take long and show nothing more
        picture = read_image(path)
        assert picture.shape == (height, width, 3)
        assert picture.dtype == np.uint8


def _check_archive(path):
    with path.open("rb") as file, open_archive(file, str(path)) as archive:
        members = wanted_members(archive, "scene", ("images",), str(path))
        for number, member in enumerate(members.values()):
            target = path.with_name(f"member{number}")
            try:
                extract(archive, member, target, lambda count: None)
            except DamagedMemberError as error:
                raise InputError(" ".join(str(error).split())) from error
            assert target.stat().st_size == member.file_size


# The files of which one is damaged, and their reader, by kind.
SINGLE_FILES = {
    "ply": (("model.ply",), _check_gaussians),
    "picture": (PICTURES, _check_picture),
    "zip": (("stored.zip", "packed.zip"), _check_archive),
}


def _refused(read):
    refusal = None
    try:
        read()
    except InputError as error:
        refusal = str(error)
    assert refusal is None or len(refusal.splitlines()) == 1
    return refusal is not None


def main(folder, first, count):
    """Run the cases ``first`` to ``first + count - 1``."""
    write_originals(folder)
    work = folder / "work"
    work.mkdir(exist_ok=True)
    refused = sum(run_case(folder, work, case) for case in cases(folder, first, count))
    print(f"{count} cases: {refused} refused, {count - refused} read")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
