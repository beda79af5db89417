"""``gsbench video``: a trained model filmed along a camera path."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsbench.logs import Progress, progress
from gsbench.verbs.arguments import ArgumentParser, path
from gsbench.view import ADDRESS

if TYPE_CHECKING:
    from gsbench.scene.camera import Camera
    from gsbench.view.picture import Picture, TrialPainter

log = logging.getLogger(__name__)

FRAMES, FPS = 120, 30.0


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if the video was written."""
    parser = ArgumentParser(
        prog="gsbench video",
        description="Film a trained model: along its cameras, or round the scene.",
    )
    parser.add_argument("trial", metavar="TRIAL", help=ADDRESS)
    parser.add_argument("--out", type=path, metavar="FILE", help=".mp4 (needs the extra video) or .webp")
    parser.add_argument(
        "--along",
        choices=("cameras", "ellipse"),
        default="cameras",
        help="a smooth way along the cameras, or an ellipse round the scene",
    )
    parser.add_argument("--frames", type=_frames, default=FRAMES, help=f"({FRAMES})")
    parser.add_argument("--fps", type=_fps, default=FPS, help=f"frames a second ({FPS:g})")
    parser.add_argument("--size", type=_size, metavar="WxH", help="px (that of the test views)")
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:1")
    options = parser.parse_args(argv)

    from gsbench.raster import create_rasterizer
    from gsbench.train.device import select_device
    from gsbench.view.picture import TrialPainter
    from gsbench.view.trials import find_trial, load_viewed, placed_cameras
    from gsbench.view.video import check_file, ellipse, has_mp4, through, write_video

    trial = find_trial(options.trial, runs)
    out = options.out or Path(f"{trial.scene}-{trial.densify}{'.mp4' if has_mp4() else '.webp'}")
    check_file(out)
    device = select_device(options.device)
    viewed = load_viewed(trial, device)
    like = viewed.views[0].camera if options.size is None else _resized(viewed.views[0].camera, *options.size)
    make = ellipse if options.along == "ellipse" else through
    cameras = make(placed_cameras(trial), like, options.frames)
    painter = TrialPainter(viewed, create_rasterizer("auto", device))
    with progress("video") as report:
        write_video(out, _film(painter, cameras, report), options.fps)
    log.info("%s: %d frames of %dx%d px", trial.label, len(cameras), cameras[0].width, cameras[0].height)
    print(out)
    return 0


def _film(painter: TrialPainter, cameras: Sequence[Camera], report: Progress) -> Iterator[Picture]:
    """The pictures [H, W, 3] uint8 of the cameras, one after the other."""
    from gsbench.view.picture import Layers

    for done, camera in enumerate(cameras, 1):
        yield painter.draw(camera, Layers())
        report("frames", done, len(cameras))


def _resized(camera: Camera, width: int, height: int) -> Camera:
    """The camera with a picture of another shape: as much is seen from top to bottom."""
    from dataclasses import replace

    scale = height / camera.height
    fx, fy = camera.fx * scale, camera.fy * scale
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=width / 2, cy=height / 2)


def _frames(text: str) -> int:
    from gsbench.view.video import MAX_FRAMES

    if not text.isascii() or not text.isdigit() or not 2 <= int(text) <= MAX_FRAMES:
        raise argparse.ArgumentTypeError(f"must be a whole number from 2 to {MAX_FRAMES}, got {text!r}")
    return int(text)


def _fps(text: str) -> float:
    from gsbench.view.video import MAX_FPS, MIN_FPS

    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not MIN_FPS <= value <= MAX_FPS:
        raise argparse.ArgumentTypeError(f"must be a number from {MIN_FPS:g} to {MAX_FPS:g}, got {text!r}")
    return value


def _size(text: str) -> tuple[int, int]:
    from gsbench.view.video import MAX_SIDE

    sides = text.split("x")
    if len(sides) != 2 or not all(side.isascii() and side.isdigit() and 16 <= int(side) <= MAX_SIDE for side in sides):
        raise argparse.ArgumentTypeError(f"must be like 640x480, each from 16 to {MAX_SIDE} px, got {text!r}")
    return int(sides[0]), int(sides[1])
