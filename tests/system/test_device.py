"""The choice of a device, its precision and its free memory."""

import pytest
import torch

from gsbench.system.resources import free_bytes, select_device
from tests.helpers import refusal, table


@pytest.fixture
def rounding():
    """Allow TF32 within the test, as torch allows it to convolutions by default."""
    backends = (torch.backends.cudnn, torch.backends.cuda.matmul)
    before = [backend.allow_tf32 for backend in backends]
    for backend in backends:
        backend.allow_tf32 = True
    yield
    for backend, value in zip(backends, before, strict=True):
        backend.allow_tf32 = value


@pytest.mark.parametrize(
    "name, gpus, answer",
    table(__file__, "a_device_is_chosen_or_refused"),
)
def test_a_device_is_chosen_or_refused(rounding, name, gpus, answer, monkeypatch):
    pretend(monkeypatch, gpus)
    with refusal(f"device={name}.*{answer}" if " " in answer else None):
        assert select_device(name) == torch.device(answer)


def test_memory_that_torch_has_reserved_and_does_not_use_is_free(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1000, 9999))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 50)
    monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 20)
    assert free_bytes(torch.device("cuda")) == 1030
    assert free_bytes(torch.device("cpu")) is None


@pytest.mark.parametrize("name", ["auto", "cuda", "cuda:1"])
def test_no_gpu_rounds_float32_to_tf32(rounding, name, monkeypatch):
    select_device("cpu")
    assert torch.backends.cudnn.allow_tf32
    pretend(monkeypatch, 2)
    assert select_device(name).type == "cuda"
    assert not torch.backends.cudnn.allow_tf32
    assert not torch.backends.cuda.matmul.allow_tf32


def test_a_gpu_that_another_program_holds_is_named(rounding, monkeypatch):
    def held(device):
        raise RuntimeError(
            "CUDA error: all CUDA-capable devices are busy or unavailable\nCUDA kernel errors "
            "might ..."
        )

    pretend(monkeypatch, 1)
    monkeypatch.setattr(torch.cuda, "mem_get_info", held)
    with refusal(r"device=auto: CUDA error: .* unavailable; does another program hold"):
        select_device("auto")


def pretend(monkeypatch, gpus):
    """Make torch report this number of GPUs."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (1, 2))
