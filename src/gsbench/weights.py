"""Finding, downloading and checking the weights of networks.

A file is searched in the folder given by the caller, then in ``$GSBENCH_WEIGHTS`` (both with
sub-folders), then in the torch hub cache. If it is not found, it is downloaded into that cache. It
is always checked before it is read, and no code in it is ever unpickled.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ConfigDict

from gsbench import downloads
from gsbench.errors import GsbenchError, InputError
from gsbench.files import atomic, file_sha256
from gsbench.logs import progress
from gsbench.words import readable_bytes

if TYPE_CHECKING:
    from torch import Tensor
    from torch.nn import Module

log = logging.getLogger(__name__)

WEIGHTS_VARIABLE = "GSBENCH_WEIGHTS"
# without a network, the error must come at once
ONE_TRY = downloads.RetryPolicy(timeout=10.0, tries=1)


class MissingWeightsError(InputError):
    """Raised if a weights file is neither found nor downloaded, or has the wrong content."""


@dataclass(frozen=True)
class WeightsFile:
    """One file of weights.

    ``names`` are the accepted file names, of which a download gets the first. ``sha256`` is the
    checksum in hexadecimal, complete or its first digits, or None if none is published; then only
    the shapes are checked. ``copies`` are names and checksums of files with the same tensors.
    ``source`` says where a copy, or a file without an address, comes from.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")  # a misspelt key would leave out a check

    names: tuple[str, ...]
    url: str | None
    sha256: str | None = None
    source: str = ""
    copies: tuple[tuple[str, str], ...] = ()

    @property
    def origin(self) -> str:
        return " or ".join(filter(None, (self.url, self.source)))


def find_weights(spec: WeightsFile, folder: Path | None = None, download: bool = True) -> Path:
    """The path of a checked copy of ``spec``.

    It is downloaded into the torch hub cache if it is not found. Raises ``InputError`` if
    ``folder`` does not exist, and ``MissingWeightsError`` if every file found has a wrong checksum,
    or if none is found and none can be downloaded.
    """
    return find_all_weights([spec], folder, download)[0]


def find_all_weights(
    specs: Sequence[WeightsFile], folder: Path | None = None, download: bool = True
) -> list[Path]:
    """Find several files as `find_weights` does; one error names all that are missing."""
    folders = _search_folders(folder)
    paths = {spec: _find_local(spec, folders) for spec in specs}
    missing = [spec for spec, path in paths.items() if path is None]
    reasons = []
    for spec in missing:
        if not download:
            reasons.append("downloads are switched off")
        elif spec.url is None:
            reasons.append("it has no address to download from")
        else:
            try:
                paths[spec] = _download(spec, hub_cache())
            except (OSError, GsbenchError) as error:
                if isinstance(error, MissingWeightsError):  # the downloaded file is damaged
                    raise
                reasons.append(f"the download failed: {error}")
                break  # without a network, each further download would fail as slowly
    still_missing = [spec for spec in missing if paths[spec] is None]
    if still_missing:
        names = ", ".join(spec.names[0] for spec in still_missing)
        sources = ", ".join(spec.origin for spec in still_missing)
        places = ", ".join(map(str, folders))
        raise MissingWeightsError(
            f"weights not found: {names} (looked in {places}; {reasons[0]}): get them from "
            f"{sources}, put them into a folder and set {WEIGHTS_VARIABLE} to it"
        )
    return [path for spec in specs if (path := paths[spec]) is not None]


def digests_of_unpinned(specs: Sequence[WeightsFile], folder: Path | None = None) -> list[str]:
    """The sha256 of the user's own files for those ``specs`` that have no published checksum.

    Such a file can be any file of the right shapes. Files in the torch hub cache were downloaded
    from the published address, so they are left out.
    """
    users = _search_folders(folder)[:-1]
    paths = [_find_local(spec, users) for spec in specs if spec.sha256 is None]
    return [file_sha256(path) for path in paths if path is not None]


def _find_local(spec: WeightsFile, folders: Sequence[Path]) -> Path | None:
    """The first file with the right checksum; None if there is no file.

    Raises ``MissingWeightsError`` if all files found have a wrong checksum.
    """
    fault, known = "", dict.fromkeys(spec.names, spec.sha256) | dict(spec.copies)
    for path, name in chain.from_iterable(_candidates(folder, known) for folder in folders):
        if not path.is_file():
            continue
        wanted = known[name]
        if wanted is None or (sha256 := file_sha256(path)).startswith(wanted):
            return path
        fault = fault or (
            f"weights file {path} has sha256 {sha256[:16]}…, expected {wanted[:16]}…: wrong "
            f"or truncated; replace it with the file from {spec.origin}"
        )
    if fault:
        raise MissingWeightsError(fault)
    return None


def load_state(path: Path, entry: str | None = None) -> dict[str, Tensor]:
    """The tensors in ``path``, on the CPU, by name.

    ``path`` is a .safetensors file, or one of PyTorch, read with ``weights_only``. ``entry`` is the
    key of the tensors in a PyTorch file that holds more. Raises ``MissingWeightsError`` if the file
    is truncated, is not a weights file, or holds anything but tensors, and if safetensors is not
    installed.
    """
    import torch

    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(path, device="cpu")
        state = torch.load(path, map_location="cpu", weights_only=True)
    except ModuleNotFoundError as error:
        raise MissingWeightsError(
            f"weights file {path} needs the package safetensors: pip install safetensors"
        ) from error
    # the two readers and pickle raise a dozen kinds of errors on a damaged or foreign file
    except Exception as error:
        raise _unreadable(path, str(error).partition("\n")[0] or type(error).__name__) from error
    if not isinstance(state, Mapping):
        raise _unreadable(path, f"it holds a {type(state).__name__}, not tensors by name")
    if entry is not None:
        if not isinstance(state.get(entry), Mapping):
            raise _unreadable(path, f"it has no entry {entry!r}")
        state = state[entry]
    if not all(isinstance(value, torch.Tensor) for value in state.values()):
        raise _unreadable(path, "it holds something other than tensors")
    return dict(state)


def load_into(network: Module, state: Mapping[str, Tensor], source: object) -> Module:
    """Load all parameters in ``state`` into ``network``, for evaluation; buffers may be missing.

    Raises ``MissingWeightsError`` that names the ``source`` if it is for another network.
    """
    try:
        missing, unexpected = network.load_state_dict(dict(state), strict=False)
    except RuntimeError as error:
        raise MissingWeightsError(
            f"weights file {source} has tensors of other shapes than the network: replace it"
        ) from error
    # Buffers are constants that a network makes itself, and published checkpoints often lack them.
    learned = {name for name, _ in network.named_parameters()}
    missing = sorted(learned.intersection(missing))
    if missing or unexpected:
        example = (missing or unexpected)[0]
        raise MissingWeightsError(
            f"weights file {source} is for another network ({len(missing)} tensors missing, "
            f"{len(unexpected)} foreign, for example {example}): replace it"
        )
    return network.requires_grad_(False).eval()


def hub_cache() -> Path:
    """The folder of torch.hub's checkpoints, below ``$TORCH_HOME``, else ``$XDG_CACHE_HOME``."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch"
    return Path(os.environ.get("TORCH_HOME", cache)).expanduser() / "hub" / "checkpoints"


def _search_folders(folder: Path | None) -> list[Path]:
    """The folders to search, in order; all but the last, `hub_cache`, with their sub-folders."""
    if folder is not None and not folder.is_dir():
        raise InputError(
            f"weights folder {folder} does not exist: give a folder, or leave it empty"
        )
    configured = os.environ.get(WEIGHTS_VARIABLE)
    places = folder, Path(configured).expanduser() if configured else None
    return [*(place for place in places if place is not None), hub_cache()]


def _candidates(folder: Path, names: Iterable[str]) -> Iterator[tuple[Path, str]]:
    """Paths that may be a file, with the name that each has."""
    yield from ((folder / name, name) for name in names)
    if folder != hub_cache() and folder.is_dir():
        yield from ((path, name) for name in names for path in sorted(folder.rglob(name)))


def _download(spec: WeightsFile, folder: Path) -> Path:
    """Download ``spec`` into ``folder``.

    The file appears under its name only after it is complete and checked.
    """
    assert spec.url is not None
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / spec.names[0]
    with atomic(target) as temporary, progress("weights") as report:

        def advance(done: int, total: int | None) -> None:
            size = readable_bytes(total)
            if done:
                report(target.name, done, total, f"{readable_bytes(done)} of {size}")
            else:
                log.info("downloading %s (%s) from %s to %s", target.name, size, spec.url, folder)

        sha256 = downloads.download(spec.url, temporary, ONE_TRY, advance)
        if not sha256.startswith(spec.sha256 or ""):
            raise MissingWeightsError(
                f"the download of {target.name} from {spec.url} is damaged: try again (its sha256 "
                f"is {sha256[:16]}…)"
            )
    return target


def _unreadable(path: Path, why: str) -> MissingWeightsError:
    return MissingWeightsError(
        f"weights file {path} cannot be read as plain tensors ({why}): replace it"
    )
