"""A small capture with exact poses, and untrained networks that still match features."""

from dataclasses import replace

import pytest
import torch

from gsbench.scene.courtyard.render import render_courtyard
from tests.scene.captures import read_colmap

VIEWS, WIDTH, HEIGHT = 8, 320, 240


@pytest.fixture(scope="session")
def courtyard(tmp_path_factory):
    """Eight views of the courtyard with their exact poses."""
    folder = tmp_path_factory.mktemp("courtyard")
    render_courtyard(folder, views=VIEWS, width=WIDTH, height=HEIGHT)
    return replace(read_colmap(folder), exact_poses=True)


@pytest.fixture(scope="session")
def bare_photos(courtyard):
    """The same views without their cameras."""
    return replace(courtyard, model=None, exact_poses=False)


@pytest.fixture(scope="session")
def untrained_weights(tmp_path_factory):
    """A weights folder with a random SuperPoint, and a LightGlue whose layers add nothing.

    Random convolutions move with the picture, so their maxima and descriptors can be matched. With
    layers that add nothing and an identity before the assignment, LightGlue picks mutual
    nearest neighbours.
    """
    transformers = pytest.importorskip("transformers", reason="needs the extra dim")
    from kornia.feature import LightGlue
    from safetensors.torch import save_file

    folder = tmp_path_factory.mktemp("weights")
    generator_state = torch.random.get_rng_state()
    torch.manual_seed(0)
    superpoint = transformers.SuperPointForKeypointDetection(transformers.SuperPointConfig())
    for module in superpoint.modules():
        if isinstance(module, torch.nn.Conv2d):
            torch.nn.init.kaiming_normal_(module.weight)
            torch.nn.init.zeros_(module.bias)
    lightglue = LightGlue(None)
    torch.random.set_rng_state(generator_state)
    save_file(superpoint.state_dict(), folder / "superpoint.safetensors")
    with torch.no_grad():
        for layer in lightglue.transformers:
            for block in (layer.self_attn, layer.cross_attn):
                block.ffn[-1].weight.zero_()
                block.ffn[-1].bias.zero_()
        for assignment in lightglue.log_assignment:
            assignment.final_proj.weight.copy_(200.0 * torch.eye(256))
            assignment.final_proj.bias.zero_()
            assignment.matchability.weight.zero_()
            assignment.matchability.bias.fill_(10.0)
    torch.save(lightglue.state_dict(), folder / "superpoint_lightglue.pth")
    return folder
