"""Checkpoints are loaded as they were saved, or not at all."""

import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest
import torch

from gsbench.gaussians.paper_values import LearningRates
from gsbench.gaussians.trainable import TrainableGaussians
from gsbench.train import checkpoint
from gsbench.train.checkpoint import CheckpointWriter, load_checkpoint, save_checkpoint, to_host
from tests.gaussians.helpers import random_gaussians


def state(step):
    rng = torch.Generator().manual_seed(step)
    return {
        "step": step,
        "tensor": torch.rand(500, generator=rng),
        "rng": rng.get_state(),
        "nested": {"list": [1, 2.5, "x", None]},
    }


def kept(folder):
    """The iterations of the checkpoints in ``folder``; fails if it has other files."""
    return sorted(int(path.name[len("checkpoint-") : -len(".pt")]) for path in folder.iterdir())


def equal(first, second):
    if isinstance(first, torch.Tensor):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(
            equal(first[key], second[key]) for key in first
        )
    return first == second


def test_the_newest_checkpoint_is_loaded_and_two_are_kept(tmp_path):
    assert load_checkpoint(tmp_path) is None
    for step in (10, 20, 30):
        save_checkpoint(tmp_path, step, state(step))
    assert kept(tmp_path) == [20, 30]
    assert equal(load_checkpoint(tmp_path), state(30))


def test_the_folder_is_synced_and_the_thread_ends(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(checkpoint, "sync_to_disk", synced.append)
    writer = CheckpointWriter(tmp_path, background=True)
    writer.save(1, state(1))
    writer.close()
    assert synced == [tmp_path]
    assert not any(thread.name.startswith("gsbench-checkpoint") for thread in threading.enumerate())


def test_a_damaged_checkpoint_is_detected_and_the_one_before_is_loaded(tmp_path, caplog):
    save_checkpoint(tmp_path, 10, state(10))
    save_checkpoint(tmp_path, 20, state(20))
    newest = tmp_path / "checkpoint-00000020.pt"
    sound = newest.read_bytes()
    rng = random.Random(0)
    for trial in range(60):
        content = bytearray(sound)
        if trial % 4:
            content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        else:
            del content[rng.randrange(len(content)) :]
        newest.write_bytes(content)
        caplog.clear()
        assert equal(load_checkpoint(tmp_path), state(10))
        assert "checkpoint-00000020.pt is damaged" in caplog.text
        assert not newest.exists()
    newest.write_bytes(sound)
    assert equal(load_checkpoint(tmp_path), state(20))


def test_loading_a_checkpoint_runs_no_code_from_it(tmp_path):
    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "hacked"),)

    save_checkpoint(tmp_path, 10, {"evil": Evil()})
    assert load_checkpoint(tmp_path) is None
    assert not (tmp_path / "hacked").exists()


def full(*arguments):
    raise OSError(28, "No space left on device")


def test_a_failed_write_leaves_the_old_checkpoint_and_no_temporary_file(tmp_path, monkeypatch):
    save_checkpoint(tmp_path, 10, state(10))
    monkeypatch.setattr(torch, "save", full)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(tmp_path, 20, state(20))
    assert kept(tmp_path) == [10]


def test_in_the_background_the_state_at_the_call_of_save_is_written(tmp_path):
    """Training continues and changes tensors in place while the thread writes."""
    writer = CheckpointWriter(tmp_path, background=True)
    live = {
        "step": 0,
        "nested": [{"tensor": torch.zeros(2_000_000)}],
        "view": torch.arange(6).view(2, 3)[:, 1],
    }
    for step in (1, 2, 3):
        live["step"] = step
        live["nested"][0]["tensor"].fill_(step)
        writer.save(step, live)
        live["nested"][0]["tensor"].fill_(-1)
    writer.close()
    assert kept(tmp_path) == [2, 3]
    loaded = load_checkpoint(tmp_path)
    assert loaded["step"] == 3
    assert bool((loaded["nested"][0]["tensor"] == 3).all())
    assert torch.equal(loaded["view"], live["view"])


def test_an_error_in_the_background_is_raised_by_the_next_save(tmp_path, monkeypatch):
    writer = CheckpointWriter(tmp_path, background=True)
    writer.save(10, state(10))
    writer.finish()
    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", full)
        writer.save(20, state(20))
        with pytest.raises(OSError, match="No space left"):
            writer.save(30, state(30))
    writer.save(40, state(40))
    writer.close()
    assert kept(tmp_path) == [10, 40]


def test_a_state_is_loaded_completely_on_another_device():
    """All tensors of a loaded state are on the device of the model."""
    initial, rates = random_gaussians(5, seed=0, dtype=torch.float32), LearningRates()
    gaussians = TrainableGaussians(initial, rates, 1.0)
    gaussians.values.means.square().sum().backward()
    gaussians.optimizer_step()
    moved = TrainableGaussians(initial.map(lambda tensor: tensor.to("meta")), rates, 1.0)
    moved.load_state_dict(to_host(gaussians.state_dict()))
    assert {tensor.device.type for tensor in moved.values.tensors().values()} == {"meta"}
    moments = moved.adam["means"]
    assert {moments.first.device.type, moments.second.device.type} == {"meta"}
    assert moments.step == 1


def test_a_kill_during_a_write_leaves_a_readable_checkpoint(tmp_path):
    code = (
        "import sys, torch; from pathlib import Path; from gsbench.train.checkpoint import "
        "CheckpointWriter\n"
        "writer = CheckpointWriter(Path(sys.argv[1]), background=True)\n"
        "for step in range(1, 10**6):\n"
        "    writer.save(step, {'step': step, 'tensor': torch.full((200_000,), float(step))})\n"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
    last = 0
    deadline = time.monotonic() + 60
    while last < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
        last = max(
            (int(path.stem.split("-")[1]) for path in tmp_path.glob("checkpoint-*.pt")), default=0
        )
    time.sleep(0.037)
    process.send_signal(signal.SIGKILL)
    process.wait()
    loaded = load_checkpoint(tmp_path)
    assert loaded["step"] >= last
    assert bool((loaded["tensor"] == loaded["step"]).all())
