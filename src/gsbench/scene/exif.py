"""The lens of a photograph, from its EXIF data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsbench.scene.images import open_image

MAKE, MODEL, EXIF_IFD = 0x010F, 0x0110, 0x8769
MAX_TEXT = 80  # characters
FOCAL_LENGTH, FOCAL_LENGTH_35MM, DIGITAL_ZOOM, LENS = 0x920A, 0xA405, 0xA404, 0xA434


@dataclass(frozen=True)
class Lens:
    """Camera and lens of a photograph; photographs with equal ones can share their intrinsics.

    ``focal_length`` in mm, ``equivalent`` in mm on 35 mm film, which a digital zoom changes too.
    """

    camera: str = ""
    lens: str = ""
    focal_length: float | None = None
    equivalent: float | None = None
    digital_zoom: float | None = None

    def __str__(self) -> str:
        parts = [self.camera or "unknown camera", self.lens]
        if self.equivalent is not None:
            parts.append(f"{self.equivalent:g} mm (on 35 mm film)")
        elif self.focal_length is not None:
            parts.append(f"{self.focal_length:g} mm")
        if self.digital_zoom is not None:
            parts.append(f"digital zoom {self.digital_zoom:g}")
        return " ".join(filter(None, parts))


def lens_of(path: Path) -> Lens:
    """The lens of a photograph; the fields that its EXIF data do not say stay empty."""
    with open_image(path) as image:
        try:
            exif = image.getexif()
            own = exif.get_ifd(EXIF_IFD)
        except Exception:  # noqa: BLE001 - as in `open_image`; the pixels may still be intact
            return Lens()
    make, model = _text(exif.get(MAKE)), _text(exif.get(MODEL))
    zoom = _number(own.get(DIGITAL_ZOOM))
    return Lens(
        camera=model if model.startswith(make) else f"{make} {model}".strip(),
        lens=_text(own.get(LENS)),
        focal_length=_number(own.get(FOCAL_LENGTH)),
        equivalent=_number(own.get(FOCAL_LENGTH_35MM)),
        digital_zoom=None if zoom == 1 else zoom,  # as if the photograph did not say
    )


def _text(value: Any) -> str:
    if not isinstance(value, str):
        return ""
    return "".join(filter(str.isprintable, value)).strip()[:MAX_TEXT]


def _number(value: Any) -> float | None:
    """A positive number to three digits, which is finer than lenses report; None if there is none.

    EXIF writes 0 for unknown.
    """
    try:
        number = float(f"{float(value):.3g}")
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 < number < float("inf") else None
