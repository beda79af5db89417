"""The store: no repeated work, no half results, damage repaired, kills and rivals survived."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from shlex import split

import pytest

from gsbench.errors import InputError
from gsbench.files import DiskFullError
from gsbench.runs.keys import Stage, Step
from gsbench.runs.layout import MANIFEST
from gsbench.runs.store import Store, read_manifest
from tests.helpers import refusal, write
from tests.processes import wait_until
from tests.runs.toy import TOY, expected_text, toy_inputs

LETTERS = Stage("letters", 1)


def write_letters(folder):
    (folder / "sub").mkdir()
    (folder / "a.txt").write_text("alpha")
    (folder / "sub/b.bin").write_bytes(bytes(range(256)))


def refuse(folder):
    raise AssertionError("built again")


BUILD = Step(LETTERS, {"x": 1}, write_letters)
FOUND = Step(LETTERS, {"x": 1}, refuse)  # the same step, which must not be built again


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path / "store")


def test_a_result_that_edited_code_may_have_built_is_not_kept(store):
    def changed():
        raise InputError("the code was edited meanwhile")

    with refusal("edited meanwhile"):
        store.get(Step(LETTERS, {"x": 1}, write_letters, check=changed))
    assert store.find(FOUND) is None
    assert not store.get(BUILD).cached
    assert store.get(Step(LETTERS, {"x": 1}, refuse, check=changed)).cached  # nothing was built now


def test_every_input_and_the_version_make_another_key(store):
    keys = {LETTERS.key(inputs) for inputs in ({"x": 1}, {"x": 2}, {"y": 1}, {"x": 1.5})}
    keys |= {stage.key({"x": 1}) for stage in (Stage("letters", 2), Stage("other", 1))}
    assert len(keys) == 6
    assert LETTERS.key({"x": 1, "y": 2}) == LETTERS.key({"y": 2, "x": 1})


@pytest.mark.parametrize("name", ["a.txt", "sub/b.bin", MANIFEST])
@pytest.mark.parametrize("damage", ["flip", "truncate", "delete"])
def test_damage_is_named_and_repaired(store, name, damage, caplog):
    path = store.get(BUILD).path / name
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 4
    if damage == "delete":
        path.unlink()
    else:
        path.write_bytes(content if damage == "flip" else content[: len(content) // 2])
    assert store.find(FOUND) is None
    mended = store.get(BUILD)
    assert not mended.cached
    assert (mended.path / "sub/b.bin").read_bytes() == bytes(range(256))
    message = " ".join(record.getMessage() for record in caplog.records)
    assert "damaged" in message
    assert name in message
    assert store.get(FOUND).cached
    assert not list(store.root.glob("*/.*.removed"))


def test_damage_is_removed_despite_the_remains_of_a_killed_removal(store):
    path = store.get(BUILD).path
    left = path.with_name(f".{path.name}.removed")
    write(left / "file", b"")
    (path / "a.txt").unlink()
    assert not store.get(BUILD).cached
    assert not left.exists()


def test_a_file_of_another_size_or_a_link_is_damaged_whatever_its_time(store):
    folder = store.get(BUILD).path
    path = folder / "a.txt"
    state = path.stat()
    path.write_text("alpha beta")
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    with pytest.raises(ValueError, match=r"a\.txt differs"):
        read_manifest(folder)
    path.unlink()
    (folder / "copy.txt").write_text("alpha")
    path.symlink_to("copy.txt")
    with pytest.raises(ValueError, match=r"a\.txt differs"):
        read_manifest(folder)


def test_every_flipped_bit_of_a_manifest_is_noticed_or_harmless(store):
    folder = store.get(BUILD).path
    sound = (folder / MANIFEST).read_bytes()
    rng = random.Random(0)
    for _ in range(300):
        content = bytearray(sound)
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        (folder / MANIFEST).write_bytes(content)
        try:
            manifest = read_manifest(folder)
        except ValueError:
            continue
        for key in split("stage version inputs key"):
            assert getattr(manifest, key) == json.loads(sound)[key]
        assert {name: entry.size for name, entry in manifest.outputs.items()} == {
            "a.txt": 5,
            "sub/b.bin": 256,
        }


def flip_a_bit(path):
    """Change a file as a failing disk does: its size and its times stay the same."""
    state, content = path.stat(), bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_a_flipped_bit_is_found_before_a_result_becomes_an_input(store, monkeypatch, caplog):
    step = BUILD
    path = store.get(step).path / "sub/b.bin"
    flip_a_bit(path)
    read_manifest(path.parents[1])  # only a thorough check reads the content
    later = Store(store.root)  # as a later process
    assert not later.get(step).cached
    assert "is damaged" in caplog.text
    assert path.read_bytes() == bytes(range(256))
    reader = Store(store.root)
    reader.get(step)
    monkeypatch.setattr("gsbench.runs.store.read_manifest", compare_no_checksums)
    assert later.get(step).cached
    assert reader.get(step).cached


def compare_no_checksums(folder, thorough=False):
    assert not thorough, "checksums were compared twice"
    return read_manifest(folder)


def test_a_copied_store_with_other_times_is_accepted_by_content(store, tmp_path):
    folder = store.get(BUILD).path
    os.utime(folder / "a.txt", ns=(1, 1))  # what copying does
    assert store.get(FOUND).cached


def test_a_failed_build_is_not_published_and_starts_from_an_empty_folder(store):
    def fail(folder):
        (folder / "half.txt").write_text("half")
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        store.get(Step(LETTERS, {"x": 1}, fail))
    assert store.find(FOUND) is None
    assert not (store.get(BUILD).path / "half.txt").exists()


def test_a_resumable_build_finds_earlier_files_without_temporaries(store):
    stage = Stage("long", 1, resumable=True, scratch=("*.scratch",))

    def half(folder):
        (folder / "half.txt").write_text("half")
        (folder / ".torn.tmp-123").write_text("to")
        (folder / "work.scratch").write_text("needed until published")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.get(Step(stage, {}, half))

    def rest(folder):
        assert {path.name for path in folder.iterdir()} == {"half.txt", "work.scratch"}
        (folder / "rest.txt").write_text("rest")

    entry = store.get(Step(stage, {}, rest))
    assert {path.name for path in entry.path.iterdir()} == {"half.txt", "rest.txt", MANIFEST}
    assert set(read_manifest(entry.path).outputs) == {"half.txt", "rest.txt"}


def test_a_killed_build_continues_without_its_links_and_its_torn_manifest(store):
    stage, seen = Stage("long", 1, resumable=True), []
    step = Step(stage, {}, lambda folder: None)
    partial = store.partial(stage, step.key)
    write(partial / MANIFEST, "{")
    (partial / "half.txt").write_text("half")
    (partial / "link").symlink_to("half.txt")
    store.on_build = lambda stage, folder: seen.append((stage, folder))
    entry = store.get(step)
    assert 0 <= entry.seconds < 60
    assert seen == [(stage, partial)]
    assert set(read_manifest(entry.path).outputs) == {"half.txt"}
    assert not partial.exists()


def test_files_are_synced_before_their_manifest_and_the_folder_after_the_rename(store, monkeypatch):
    synced = []
    note = lambda path: synced.append((path.name, (path.parent / MANIFEST).exists()))  # noqa: E731
    monkeypatch.setattr("gsbench.runs.store.sync_to_disk", note)
    store.get(BUILD)
    assert synced == [("a.txt", False), ("b.bin", False), ("letters", False)]


def test_a_build_killed_between_manifest_and_rename_is_published_without_building(store):
    entry = store.get(BUILD)
    os.replace(entry.path, store.partial(LETTERS, entry.key))
    again = store.get(FOUND)
    assert again.seconds == entry.seconds
    assert store.find(FOUND) is not None


def test_sweep_removes_leftovers_and_keeps_what_a_build_would_continue(store):
    long = Stage("long", 1, resumable=True)
    entry = store.get(Step(long, {"x": 1}, write_letters))
    stale = store.partial(long, entry.key)
    useful = store.partial(long, "1" * 64)
    useless = store.partial(LETTERS, "2" * 64)
    half_removed = store.root / "long/.33.removed"
    for folder in (stale, useful, useless, half_removed):
        write(folder / "file", "x")
    store.sweep([long, LETTERS])
    assert useful.exists()
    assert not any(folder.exists() for folder in (stale, useless, half_removed))
    assert store.get(Step(long, {"x": 1}, refuse)).cached


def toy(store, number, *options):
    command = [sys.executable, "-m", "tests.runs.toy", str(store.root), str(number), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_builds_killed_at_random_moments_end_with_the_right_results(store):
    """Kill a process that builds three results, again and again; nothing torn is ever published."""
    rng = random.Random(1)
    kills = 0
    for _ in range(100):
        # six seconds of pauses, on any machine: more than three waits
        process = toy(store, 3, "--slow", "--ready")
        # a busy machine may need longer to start than to be killed
        assert process.stdout.readline() == "ready\n"
        try:
            process.wait(rng.uniform(0.0, 1.4))
            break
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
            kills += 1
        for number in range(3):
            entry = store.find(Step(TOY, toy_inputs(number), refuse))
            if entry is not None:
                assert (entry.path / "lines.txt").read_text() == expected_text(number)
    assert process.returncode == 0
    assert kills >= 3
    for number in range(3):
        entry = store.get(Step(TOY, toy_inputs(number), refuse))
        assert (entry.path / "lines.txt").read_text() == expected_text(number)
    # The note on a lock's holder remains if the holder was killed before it let go.
    left = {
        path.name
        for path in (store.root / "toy").iterdir()
        if not path.name.endswith((".lock", ".lock.holder"))
    }
    assert left == {TOY.key(toy_inputs(number)) for number in range(3)}


@pytest.mark.slow
def test_processes_that_want_the_same_result_build_it_once_and_say_what_they_wait_for(store):
    processes = [toy(store, 1, "--slow") for _ in range(4)]
    results = [process.communicate(timeout=300) for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0, 0]
    assert sorted(out.strip() for out, _ in results) == split("built found found found")
    waiting = [err for out, err in results if out.strip() == "found"]
    assert any("waiting for toy" in err and "process" in err for err in waiting)


def test_a_killed_process_frees_its_lock(store):
    first = toy(store, 1, "--slow")
    key = TOY.key(toy_inputs(0))
    wait_until(store.partial(TOY, key).exists)
    second = toy(store, 1)
    time.sleep(0.3)
    first.send_signal(signal.SIGKILL)
    first.wait()
    out, _ = second.communicate(timeout=300)
    assert out.strip() == "built"
    assert (store.folder(TOY, key) / "lines.txt").read_text() == expected_text(0)


def test_a_full_disk_is_reported_in_one_line_and_corrupts_nothing(small_disk):
    store = Store(small_disk / "store")
    sound = store.get(BUILD)

    def big(folder):
        (folder / "big.bin").write_bytes(bytes(4 << 20))

    with pytest.raises(DiskFullError, match=r"is full: free some space") as caught:
        store.get(Step(LETTERS, {"x": 2}, big))
    assert "\n" not in str(caught.value)
    assert store.find(Step(LETTERS, {"x": 2}, refuse)) is None
    assert store.get(FOUND).path == sound.path
    store.sweep([LETTERS])
    assert not store.get(Step(LETTERS, {"x": 2}, write_letters)).cached


def test_a_read_only_store_gives_its_results_and_refuses_to_build(small_disk):
    store = Store(small_disk / "store")
    store.get(BUILD)
    subprocess.run(split(f"mount -o remount,ro {small_disk}"), check=True)
    assert store.get(FOUND).cached
    with refusal("cannot be written to"):
        store.get(Step(LETTERS, {"x": 2}, write_letters))
