"""Deep image matching with untrained networks, and the behaviour that it needs of libraries."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal
from torch.testing import assert_close

from gsbench.init import MODEL_FOLDER, Dim, networks, read_cloud
from gsbench.init.networks import (
    EXTRACTORS,
    SUPERPOINT_BORDER,
    Features,
    build_matcher,
    extract_features,
    match,
    mutual_nearest_matcher,
)
from gsbench.weights import MissingWeightsError, load_state
from tests.helpers import refusal
from tests.init.tables import TABLES
from tests.scene.courtyard.surfaces import surface_distance

CPU = torch.device("cpu")
LIGHTGLUE = "superpoint_lightglue.pth"


@pytest.fixture(autouse=True)
def no_weights_elsewhere(tmp_path, monkeypatch):
    monkeypatch.delenv("GSBENCH_WEIGHTS", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


@pytest.fixture(scope="module")
def few(courtyard):
    return replace(courtyard, image_names=courtyard.image_names[:4])


def superpoint(weights, **options):
    return Dim(weights=weights, download=False, **{"max_keypoints": 400, "threads": 1, **options})


def matcher_of(weights):
    own = superpoint(None)
    return build_matcher(own.extraction, own.matching, weights, CPU)


def features_of(descriptors, keypoints=0.0, size=(9, 9), file_size=None):
    """Features of an image, by default all at one place."""
    count, own = len(descriptors), descriptors.astype(np.float32)
    places = np.zeros((count, 2), np.float32) + np.float32(keypoints)
    return Features(places, own, np.ones(count, np.float32), size, file_size or size)


def no_gpu(*_):
    raise torch.OutOfMemoryError("CUDA out of memory")


# ---- the whole path, with untrained networks


@pytest.fixture(scope="module")
def untrained(courtyard, untrained_weights, tmp_path_factory):
    output = tmp_path_factory.mktemp("dim")
    init = superpoint(untrained_weights, matcher="mutual_nearest")
    return init, init.run(courtyard, output / "out", work_dir=output / "work"), output


@pytest.mark.slow
def test_cloud_lies_on_the_surfaces(untrained):
    _, report, output = untrained
    assert (report.init, report.poses, report.num_registered) == ("dim", "shared", 8)
    assert report.counts["features"] == 8 * 400
    assert report.settings["extractor"] == "superpoint"
    assert report.settings["keypoint_threshold"] == 0.0005
    assert len(report.settings["weights_sha256"]["superpoint.safetensors"]) == 64
    assert "transformers" in report.versions
    assert np.median(surface_distance(read_cloud(output / "out" / MODEL_FOLDER).points)) < 0.15


@pytest.mark.slow
def test_lightglue_matches_enough_points(few, untrained_weights, tmp_path, caplog):
    own = {"max_keypoints": 256, "filter_threshold": 0.0, "pairs": "sequential", "overlap": 1}
    report = superpoint(untrained_weights, **own).run(few, tmp_path)
    assert report.counts["pairs_selected"] == 3
    assert report.counts["inlier_matches"] > 30
    assert len(report.settings["weights_sha256"]) == 2
    assert sum("noncommercial" in message for message in caplog.messages) == 1


# ---- undocumented behaviour of transformers and kornia on which the code relies


@pytest.mark.parametrize("width, height", [(128, 96), (331, 41)])
def test_superpoint_keypoints_are_the_maxima_of_its_score_map(untrained_weights, width, height):
    settings = superpoint(untrained_weights, max_keypoints=10**6).extraction
    weights = untrained_weights / "superpoint.safetensors"
    extract = EXTRACTORS["superpoint"](settings, weights, CPU)
    transformers = pytest.importorskip("transformers")
    config = transformers.SuperPointConfig(nms_radius=3)
    network = transformers.SuperPointForKeypointDetection(config).eval()
    network.load_state_dict(load_state(weights))
    image = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        keypoints, descriptors, scores = extract(image)
        gray = (image * torch.tensor([0.299, 0.587, 0.114])[:, None, None]).sum(1, keepdim=True)
        encoded = network.encoder(gray).last_hidden_state
        score_map = network.keypoint_decoder._get_pixel_scores(encoded)[0]
    border = SUPERPOINT_BORDER
    inner = score_map[border : height - border, border : width - border]
    expected = torch.nonzero(inner > 0.0005).flip(1) + border  # x, y
    assert set(map(tuple, keypoints.int().tolist())) == set(map(tuple, expected.tolist()))
    assert len(keypoints) > 10
    assert torch.equal(keypoints, keypoints.round())
    for (x, y), score in zip(keypoints[:20].int().tolist(), scores[:20], strict=True):
        assert score_map[y, x] == score
    assert_close(descriptors.norm(dim=1), torch.ones(len(keypoints)))


def test_lightglue_finds_a_permutation_with_images_of_different_sizes(untrained_weights):
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(100, 256)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    order = rng.permutation(100)[:80]
    keypoints = rng.uniform(0, 60, (100, 2)).astype(np.float32)
    first = features_of(descriptors, keypoints, (100, 80))
    second = features_of(descriptors[order], keypoints[order], (64, 200), (640, 2000))
    matches = matcher_of(untrained_weights / LIGHTGLUE)(first, second)
    assert matches.dtype == np.uint32
    assert len(matches) > 60  # width pruning may drop some
    assert_array_equal(order[matches[:, 1]], matches[:, 0])


def test_lightglue_reads_the_published_names(untrained_weights, tmp_path, monkeypatch):
    """Tensors are self_attn.0.… in published files, transformers.0.self_attn.… in the network."""
    state = torch.load(untrained_weights / LIGHTGLUE, weights_only=True)
    published = {}
    for name, value in state.items():
        parts = name.split(".")
        if parts[0] == "transformers":
            name = ".".join([parts[2], parts[1], *parts[3:]])
        published[name] = value
    published.pop("confidence_thresholds")
    torch.save(published, tmp_path / "published.pth")
    loaded_into, load_into = [], networks.load_into

    def note(network, *rest):
        loaded_into.append(network)
        return load_into(network, *rest)

    monkeypatch.setattr(networks, "load_into", note)
    matcher_of(tmp_path / "published.pth")
    loaded = loaded_into[0].state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in state.items())


def test_no_network_is_downloaded_by_the_libraries(untrained_weights, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a library tried to download")

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    monkeypatch.setattr("kornia.feature.lightglue.load_state_dict_from_url", refuse)
    matcher_of(untrained_weights / LIGHTGLUE)
    EXTRACTORS["superpoint"](
        superpoint(None).extraction, untrained_weights / "superpoint.safetensors", CPU
    )


def test_disk_is_loaded_from_its_published_layout(tmp_path):
    from kornia.feature import DISK

    torch.manual_seed(0)
    content = {"extractor": DISK().state_dict(), "optimizer": {"lr": 1.0}}
    torch.save(content, tmp_path / "depth-save.pth")
    settings = Dim(extractor="disk", matcher="mutual_nearest", max_keypoints=50).extraction
    extract = EXTRACTORS["disk"](settings, tmp_path / "depth-save.pth", CPU)
    with torch.inference_mode():
        keypoints, descriptors, scores = extract(torch.rand(1, 3, 75, 101))
    assert len(keypoints) == len(scores) <= 50
    assert descriptors.shape == (len(keypoints), 128)
    assert (keypoints >= 0).all()
    assert (keypoints < torch.tensor([101, 75])).all()


@pytest.mark.parametrize("extractor, threshold, radius", TABLES["detection by extractor"])
def test_detection_settings_are_the_extractors_own_unless_given(extractor, threshold, radius):
    """The defaults are those of deep-image-matching and the authors."""
    own = Dim(extractor=extractor)
    found = own.extraction["keypoint_threshold"], own.extraction["nms_radius"]
    assert found == (threshold, radius)
    given = {"keypoint_threshold": 0.0}
    # features depend on exactly these settings
    rest = {"extractor": extractor, "max_image_size": 1600, "max_keypoints": 2048}
    assert replace(own, **given).extraction == rest | given | {"nms_radius": radius}
    assert own.matching == {"matcher": "lightglue", "filter_threshold": 0.1}
    nearest = {"matcher": "mutual_nearest", "max_ratio": 0.95}
    assert replace(own, **nearest).matching == nearest


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "superpoint.safetensors, superpoint_lightglue_v0-1_arxiv-pth"),
        ({"extractor": "aliked"}, "aliked-n16.pth has sha256 .* expected 5be8704840ed662d"),
    ],
)
def test_missing_and_wrong_weights_are_named_before_any_work(courtyard, tmp_path, options, said):
    (tmp_path / "aliked-n16.pth").write_bytes(b"not ALIKED")
    weights = tmp_path if options else None
    with pytest.raises(MissingWeightsError, match=said):
        Dim(weights=weights, download=False, **options).run(courtyard, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_weights_of_another_network_or_shape_are_refused(untrained_weights, tmp_path):
    state = torch.load(untrained_weights / LIGHTGLUE, weights_only=True)
    state["log_assignment.0.final_proj.weight"] = torch.zeros(3, 3)
    torch.save(state, tmp_path / "bad.pth")
    torch.save({"conv.weight": torch.zeros(3)}, foreign := tmp_path / "foreign.pth")
    aliked = partial(EXTRACTORS["aliked"], Dim(extractor="aliked").extraction, device=CPU)
    for build, file, said in (
        (matcher_of, foreign, "is for another network"),
        (aliked, foreign, "is for another network"),
        (matcher_of, tmp_path / "bad.pth", "other shapes"),
    ):
        with pytest.raises(MissingWeightsError, match=said):
            build(file)


def test_too_little_gpu_memory_is_reported(courtyard):
    features = features_of(np.zeros((1000, 8)))
    with refusal(r"1000 keypoints ran out of memory: lower init.max_image_size"):
        match(no_gpu, features, features)
    with refusal(r"0000.png: cpu ran out of memory at 320x240 px"):
        extract_features(courtyard.images / "0000.png", no_gpu, Dim().extraction, CPU)


def test_an_empty_image_has_no_matches():
    some, none = features_of(np.eye(3, 8)), features_of(np.eye(0, 8))
    assert match(mutual_nearest_matcher(0.9, CPU), some, none).shape == (0, 2)


def test_an_unknown_device_is_refused(courtyard, untrained_weights, tmp_path):
    with refusal(r"init\.device=tpu is not known to torch"):
        superpoint(untrained_weights, device="tpu").run(courtyard, tmp_path)


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize("extractor", ["aliked", "disk"])
def test_lightglue_with_real_weights_finds_points_on_the_surfaces(
    few, trained_weights, tmp_path, extractor
):
    own = {"max_keypoints": 500, "threads": 1, "pairs": "sequential", "overlap": 2}
    init = Dim(extractor=extractor, weights=trained_weights, download=False, **own)
    report = init.run(few, tmp_path)
    assert len(report.settings["weights_sha256"]) == 2
    assert report.versions["kornia"]
    assert report.num_points > 100
    assert np.median(surface_distance(read_cloud(tmp_path / MODEL_FOLDER).points)) < 0.05  # m
