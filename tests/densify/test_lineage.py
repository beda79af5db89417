"""Reading of the record of causes, which anybody may have written."""

import zipfile

import numpy as np
import pytest

from gsbench.densify.lineage import read_causes
from tests.helpers import refusal

IDS, CAUSES = np.array([3, 0]), np.array([0, 1, 2, 5], np.uint8)


def test_causes_are_those_of_the_present_gaussians(tmp_path):
    np.savez(tmp_path / "lineage.npz", ids=IDS, causes=CAUSES)
    assert read_causes(tmp_path / "lineage.npz", 2).tolist() == [5, 0]
    with refusal("is of 2 Gaussians, the model has 1: run"):
        read_causes(tmp_path / "lineage.npz", 1)


@pytest.mark.parametrize(
    "arrays",
    [
        {"ids": IDS},
        {"ids": IDS, "causes": np.array(["clone"] * 4)},
        {"ids": IDS.astype(float), "causes": CAUSES},
        {"ids": IDS, "causes": CAUSES + np.uint8(1)},  # a cause that does not exist
        {"ids": -IDS, "causes": CAUSES},
        {"ids": IDS + 1, "causes": CAUSES},
        {"ids": IDS, "causes": CAUSES.reshape(2, 2)},
        {"ids": IDS, "causes": np.array([{}] * 4)},  # pickled objects
    ],
)
def test_impossible_causes_are_refused(tmp_path, arrays):
    np.savez(tmp_path / "lineage.npz", **arrays)
    with refusal(r"lineage\.npz cannot be read"):
        read_causes(tmp_path / "lineage.npz", 2)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 no zip", b"no zip at all"])
def test_a_damaged_file_is_refused(tmp_path, content):
    (tmp_path / "lineage.npz").write_bytes(content)
    with refusal(r"lineage\.npz cannot be read"):
        read_causes(tmp_path / "lineage.npz", 1)


def test_an_array_that_announces_more_than_there_is_is_refused(tmp_path):
    header = b"{'descr': '|u1', 'fortran_order': False, 'shape': (1000000000000,), }"
    header += b" " * (117 - len(header)) + b"\n"
    array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(tmp_path / "lineage.npz", "w") as archive:
        archive.writestr("causes.npy", array)
        archive.writestr("ids.npy", array)
    with refusal(r"lineage\.npz cannot be read"):
        read_causes(tmp_path / "lineage.npz", 1)
