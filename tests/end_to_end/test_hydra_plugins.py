"""Other plug-ins for Hydra, through the real program: Optuna's sweeper, Ray, and Hydra's files.

Two of them need older packages than gsbench's own search and tracker, so ``make
test-hydra-plugins`` installs them into a folder of their own. Without it these tests are skipped.
"""

import statistics
import time
from collections import defaultdict
from importlib.util import find_spec

import psutil
import pytest
import yaml

from tests.end_to_end.test_hydra import SECONDS, TINY, results_below

pytestmark = pytest.mark.slow


def need(package):
    if find_spec(f"hydra_plugins.{package}") is None:
        pytest.skip(f"needs {package.replace('_', '-')}: make test-hydra-plugins (or group dev)")


# ---- sweepers


@pytest.mark.parametrize("direction", ["minimize", "maximize"])
def test_optunas_sweeper_looks_for_the_best_mean_over_seeds(gsbench, tmp_path, direction):
    need("hydra_optuna_sweeper")
    small = [word for word in TINY if not word.startswith("init.count")]
    words = [
        "-m",
        *small,
        "name=x",
        "seed=0,1",
        "init.count=int(interval(100,400))",
        "hydra/sweeper=optuna",
    ]
    words += ["hydra.sweeper.n_trials=3", f"hydra.sweeper.direction={direction}"]
    look = gsbench(*words, "--dry-run")
    assert "hydra/sweeper=optuna searches: it proposes 3 trials" in look.stdout, look.stderr
    assert not (tmp_path / "runs").exists()

    done = gsbench(*words)
    assert f"psnr of validation views, {direction}d" in done.stderr
    psnr = defaultdict(list)
    for result in results_below(tmp_path / "runs/x-tune"):
        psnr[result["num_init_points"]].append(result["metrics"]["psnr"])
    assert all(len(values) == 2 for values in psnr.values())
    best = max(psnr, key=lambda count: statistics.fmean(psnr[count]))
    found = yaml.safe_load((tmp_path / "runs/.hydra/optimization_results.yaml").read_text())
    assert found["best_params"] == {"init.count": best}
    sign = 1 if direction == "maximize" else -1
    assert found["best_value"] == pytest.approx(sign * statistics.fmean(psnr[best]))


def test_settings_that_a_sweeper_does_not_understand_are_refused_in_one_line(gsbench, tmp_path):
    need("hydra_optuna_sweeper")
    for words in (["hydra.sweeper.params=3"], ["hydra.sweeper.direction=up", "seed=0,1"]):
        done = gsbench(
            "-m",
            *TINY,
            "hydra/sweeper=optuna",
            *words,
            code=2,
        )
        assert "Traceback" not in done.stderr
        assert done.stderr.splitlines()[-1].startswith("gsbench: ")


def test_a_strangers_texts_for_a_sweeper_are_refused(gsbench, tmp_path):
    need("hydra_optuna_sweeper")
    (tmp_path / "bomb.py").write_text("open('exploded', 'w')\ndef bomb(*rest): ...\n")
    for word in (
        "hydra.sweeper.custom_search_space=bomb.bomb",
        "hydra.sweeper.storage=sqlite:///exploded",
    ):
        done = gsbench(
            "-m",
            *TINY,
            "hydra/sweeper=optuna",
            "seed=0,1",
            word,
            code=2,
        )
        assert "allow_targets=[hydra.sweeper]" in done.stderr
    assert not (tmp_path / "exploded").exists()


# ---- Ray


@pytest.fixture
def cluster():
    """A Ray cluster of two nodes on this machine, each with one worker."""
    need("hydra_ray_launcher")
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 10**8}
    cluster = Cluster(initialize_head=True, head_node_args=node | {"include_dashboard": False})
    cluster.add_node(**node)
    yield cluster
    cluster.shutdown()


def ray_workers():
    """The processes of the cluster that run a job now."""
    found = []
    for process in psutil.Process().children(recursive=True):
        try:
            found += [process] * any("ray::_run_job" in word for word in process.cmdline())
        except psutil.Error:
            continue
    return found


def test_ray_runs_a_sweep_on_two_nodes_and_survives_a_killed_worker(
    cluster, start, tmp_path, gsbench
):
    words = ["-m", *TINY, "name=x", "seed=0,1,2,3,4,5,6,7", "hydra/launcher=ray"]
    words += [
        "hydra.launcher.ray.init.address=auto",
        "+hydra.launcher.ray.init.object_store_memory=null",
    ]
    program = start(*words, RAY_ADDRESS=cluster.address)
    at_once, killed = 0, 0
    until = time.monotonic() + SECONDS
    while program.poll() is None and time.monotonic() < until:
        workers = ray_workers()
        if not killed:  # afterwards a worker that ends and the one in its place may both be listed
            at_once = max(at_once, len(workers))
        if not killed and at_once == 2 and list((tmp_path / "runs").glob("x/*/*/*/log.txt")):
            workers[-1].kill()
            killed = workers[-1].pid
        time.sleep(0.2)
    out, _ = program.communicate(timeout=SECONDS)
    assert (program.returncode, at_once, bool(killed)) == (0, 2, True), out
    assert "8 of 8 trials done" in out
    assert sorted(result["seed"] for result in results_below(tmp_path / "runs/x")) == list(range(8))


# ---- Hydra's own files and logs


def test_hydra_writes_its_files_to_the_given_folders(gsbench, tmp_path):
    words = [*TINY, "name=x", "hydra.run.dir=own", "hydra.verbose=true", "hydra.job.chdir=true"]
    done = gsbench(*words)
    (result,) = (tmp_path / "runs/x").rglob("results.json")  # and not below own/
    assert f"paths still start in {tmp_path}" in done.stderr
    assert yaml.safe_load((tmp_path / "own/.hydra/config.yaml").read_text())["name"] == "x"
    assert f"the trial's folder is {result.parent}" in (tmp_path / "own/gsbench.log").read_text()

    sweep = ["-m", *TINY, "name=x", "seed=0,1", "hydra.sweep.dir=many", "hydra.output_subdir=h"]
    done = gsbench(*sweep)
    for job in ("0", "1"):
        assert yaml.safe_load((tmp_path / f"many/{job}/h/config.yaml").read_text())["seed"] == int(
            job
        )
    assert len(list((tmp_path / "runs/x").rglob("results.json"))) == 2


def test_colours_of_a_log_reach_the_terminal(gsbench, tmp_path):
    need("hydra_colorlog")
    words = [*TINY, "name=x", "hydra/job_logging=colorlog", "hydra/hydra_logging=colorlog"]
    assert "\x1b[32mINFO" in gsbench(*words).stdout


def test_debug_lines_are_shown_if_they_are_asked_for(gsbench, tmp_path):
    (tmp_path / "own.py").write_text(
        "import logging\nfrom gsbench.densify import NoDensifier\nclass Own(NoDensifier):\n    def "
        "observe(self, *rest, **named):\n        logging.getLogger('gsbench.own').debug('a "
        "detail')\n        logging.getLogger('other.own').debug('another detail')\n"
    )
    words = [*TINY, "densify._target_=own.Own", "allow_targets=[own]"]
    for name, word, shown in (
        ("quiet", "hydra.verbose=false", (False, False)),
        ("all", "hydra.verbose=true", (True, False)),
        ("one", "hydra.verbose=[other]", (False, True)),
    ):
        done = gsbench(
            *words,
            f"name={name}",
            word,
            "train.iterations=2",
            GSBENCH_RUNS=f"runs-{name}",
        )
        assert ("a detail" in done.stderr, "another detail" in done.stderr) == shown, name
