"""The programs, shell lines, options of Slurm and variables that a configuration may use."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from gsbench.config.permissions import permission_advice
from gsbench.errors import InputError
from gsbench.external.settings import program_of
from gsbench.runs.nested import TARGET

# import paths of one class
EXTERNAL = ("gsbench.densify.External", "gsbench.external.settings.External")
# the permissions for shell lines, and for unusual options of Slurm
SHELL, SBATCH = "bash", "sbatch"
# Variables that a configuration may set: they choose numbers of threads and devices. This is a list
# of harmless ones, since no list of dangerous ones could be complete: MPLBACKEND imports a module,
# NUMBA_CACHE_DIR unpickles, CUDA_INJECTION64_PATH and GCONV_PATH load libraries, CC names a
# program.
FREE_VARIABLES = frozenset(
    """
    OMP_NUM_THREADS OMP_THREAD_LIMIT OMP_DYNAMIC OMP_PROC_BIND OMP_PLACES OMP_SCHEDULE OMP_STACKSIZE
    OMP_WAIT_POLICY MKL_NUM_THREADS OPENBLAS_NUM_THREADS NUMEXPR_NUM_THREADS NUMBA_NUM_THREADS
    VECLIB_MAXIMUM_THREADS CUDA_VISIBLE_DEVICES CUDA_DEVICE_ORDER CUDA_LAUNCH_BLOCKING
    CUBLAS_WORKSPACE_CONFIG PYTORCH_CUDA_ALLOC_CONF HIP_VISIBLE_DEVICES ROCR_VISIBLE_DEVICES TZ
    """.split()  # noqa: SIM905 - words are easier to read than a list of 20 quoted ones
)
# Variables that any configuration may read: places, names and devices. All others may be secrets.
READABLE_VARIABLES = FREE_VARIABLES | {"HOME", "USER", "PWD", "TMPDIR", "SCRATCH", "WORK"}
OWN_VARIABLES = "GSBENCH_"
# Options of sbatch that choose resources (from Slurm's manual). Others can run a program
# (task_prolog), start a container, or pass on variables (export).
SBATCH_RESOURCES = frozenset(
    """
    account begin clusters comment constraint contiguous core_spec cores_per_socket cpu_freq
    cpus_per_gpu cpus_per_task deadline dependency exclude exclusive gpu_bind gpu_freq gpus
    gpus_per_node gpus_per_socket gpus_per_task gres gres_flags hint hold licenses mail_type
    mail_user mem mem_bind mem_per_cpu mem_per_gpu mincpus network nice nodelist nodes ntasks
    ntasks_per_core ntasks_per_gpu ntasks_per_node ntasks_per_socket overcommit oversubscribe
    partition prefer priority qos requeue reservation signal sockets_per_node spread_job switches
    thread_spec threads_per_core time time_min tmp use_min_nodes wckey
    """.split()  # noqa: SIM905
)


def is_external(densify: Mapping[str, Any]) -> bool:
    """Return whether these settings make another program the trainer.

    They do if their class has one of the import paths `EXTERNAL`.
    """
    return densify.get(TARGET) in EXTERNAL


def check_program(settings: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse a program as trainer unless the user allowed its programs and variables."""
    # A YAML file may call any program of this machine a trainer, or load code into one by a
    # variable.
    options = settings.get("options") or {}
    programs = [program_of(settings.get("command") or "", options)]
    if settings.get("version_command") is not None:
        programs.append(program_of(settings["version_command"], options, "densify.version_command"))
    programs = [program for program in dict.fromkeys(programs) if program not in allowed]
    variables = foreign_variables(settings.get("environment") or {}, allowed)
    acts = []
    if programs:
        acts.append(f"runs the program {' and '.join(map(repr, programs))}")
    if variables:
        acts.append("sets " + ", ".join(f"{name}={value!r}" for name, value in variables.items()))
    if acts:
        raise InputError(
            f"densify={settings['name']} {' and '.join(acts)}; if you trust it, "
            + permission_advice([*programs, *variables], allowed)
        )


def foreign_variables(variables: Mapping[str, Any], allowed: Sequence[str]) -> dict[str, Any]:
    """The ``variables`` that may not be set: neither free nor allowed nor at this value already."""
    return {
        name: value
        for name, value in variables.items()
        if name not in FREE_VARIABLES and name not in allowed and value != os.environ.get(name)
    }


def reading(variable: str) -> str:
    """The permission to read a variable: another word than the one that allows to set it."""
    return f"env:{variable}"


def is_readable(variable: str, allowed: Sequence[str]) -> bool:
    """Return whether a configuration may read the variable, so that results have its value."""
    return (
        variable in READABLE_VARIABLES
        or variable.startswith(OWN_VARIABLES)
        or reading(variable) in allowed
    )


def check_launch(launch: Mapping[str, Any], allowed: Sequence[str]) -> None:
    """Refuse lines for a shell, and values that could become one in the script that Slurm runs."""
    if launch.get("setup") and SHELL not in allowed:
        raise InputError(
            f"launch.setup runs {'; '.join(map(str, launch['setup']))!r} in a shell; if you trust "
            "it, " + permission_advice([SHELL], allowed)
        )
    options = {
        str(name).replace("-", "_"): value for name, value in (launch.get("sbatch") or {}).items()
    }
    if (not_resources := sorted(options.keys() - SBATCH_RESOURCES)) and SBATCH not in allowed:
        raise InputError(
            f"launch.sbatch.{not_resources[0]} chooses more than resources; if you trust it, "
            + permission_advice([SBATCH], allowed)
        )
    texts = {f"launch.{name}": launch.get(name) for name in ("partition", "account", "qos")}
    texts |= {f"launch.sbatch.{name}": value for name, value in options.items()}
    # a line break would end the comment that Slurm reads, and begin a command
    for key, value in texts.items():
        if not str(value).isprintable() or not key.isprintable():
            raise InputError(f"{key} must be one line, got {value!r}")
