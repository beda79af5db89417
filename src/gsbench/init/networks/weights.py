"""The weights files of the extractors and of LightGlue: their names, sources, licences and checksums."""

from __future__ import annotations

from gsbench.weights import WeightsFile

SUPERPOINT_LICENCE = "Magic Leap: academic or non-profit noncommercial research use only"

EXTRACTOR_WEIGHTS: dict[str, WeightsFile] = {
    "superpoint": WeightsFile(
        names=(
            "superpoint.safetensors",
            "superpoint/model.safetensors",
            "lightglue_superpoint/model.safetensors",
        ),
        url="https://huggingface.co/magic-leap-community/superpoint/resolve/main/model.safetensors",
        sha256=None,
        licence=SUPERPOINT_LICENCE,
        source="huggingface.co/magic-leap-community/superpoint",
    ),
    "disk": WeightsFile(
        names=("depth-save.pth",),
        url="https://raw.githubusercontent.com/cvlab-epfl/disk/master/depth-save.pth",
        sha256=None,
        licence="Apache-2.0",
        source="github.com/cvlab-epfl/disk",
    ),
}

_ALIKED_SHA256 = {
    "n16": "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
    "n16rot": None,
    "n32": "055283fd1624d3ab46a05c3b617b1a79a3f28d1f551737eef2d653e8c8232890",
    "t16": "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
}
ALIKED_WEIGHTS: dict[str, WeightsFile] = {
    model: WeightsFile(
        names=(f"aliked-{model}.pth",),
        url=f"https://github.com/Shiaoming/ALIKED/raw/main/models/aliked-{model}.pth",
        sha256=sha256,
        licence="BSD-3-Clause",
        source="github.com/Shiaoming/ALIKED",
    )
    for model, sha256 in _ALIKED_SHA256.items()
}

LIGHTGLUE_WEIGHTS: dict[str, WeightsFile] = {
    extractor: WeightsFile(
        # the first is the name under which kornia and cvg/LightGlue keep it in the torch hub cache (sic: "-pth")
        names=(f"{extractor}_lightglue_v0-1_arxiv-pth", f"{extractor}_lightglue.pth"),
        url=f"https://github.com/cvg/LightGlue/releases/download/v0.1_arxiv/{extractor}_lightglue.pth",
        sha256=None,
        licence="Apache-2.0",
        source="github.com/cvg/LightGlue",
    )
    for extractor in ("superpoint", "disk", "aliked")
}
