"""The command line ``gsbench``: a Hydra app, and verbs.

A first word without ``=``, ``+``, ``~`` or ``-`` is a verb. Nothing here loads torch, so that
``--help`` and the verbs that only read files answer at once.
"""

import gc
import sys

INTERRUPTED = 130  # 128 + SIGINT, as shells count

# The imports are in the block, because a Ctrl-C during them would otherwise print a traceback.
try:
    import os
    from contextlib import suppress
    from pathlib import Path

    from gsbench import __version__
    from gsbench.errors import GsbenchError, InputError
    from gsbench.files import checked_runs_folder, storage_errors
    from gsbench.logs import OutputError, begin_command, open_streams, printable_output
    from gsbench.system.programs import protect_environment
    from gsbench.words import did_you_mean
except KeyboardInterrupt:
    print("gsbench: stopped before it began", file=sys.stderr)
    sys.exit(INTERRUPTED)

HELP = ("--help", "-h")
DONE, TRIAL_FAILED, BAD_INPUT = 0, 1, 2
NEW_OBJECTS = 10_000  # between two garbage collections


def main() -> None:
    """Entry point of the console script."""
    # Python's own threshold is 700. Imports and kernels make a million objects that stay, and
    # looking through them again and again takes a tenth of their time.
    gc.set_threshold(NEW_OBJECTS)
    open_streams()
    with printable_output():
        code = run(sys.argv[1:])
    # Python would look through all of them once more at its end: a second after kernels compiled.
    gc.freeze()
    sys.exit(code)


def run(argv: list[str]) -> int:
    """Run the command line ``argv``; returns the exit code and prints errors as one line."""
    with suppress(OSError):  # the current folder was deleted: `_require_current_folder` says it
        protect_environment()
    begin_command()
    try:
        try:
            return _command(argv)
        finally:
            sys.stdout.flush()  # here, where a full disk is explained, and not when Python ends
    except InputError as error:
        return _refuse(error, BAD_INPUT)
    except OutputError as error:
        _drop_output()
        return _refuse(error, TRIAL_FAILED)
    except GsbenchError as error:
        return _refuse(error, TRIAL_FAILED)
    except KeyboardInterrupt as stop:
        print(
            f"gsbench: stopped{f' by {stop}' if str(stop) else ''}; to continue, give the same "
            "command again",
            file=sys.stderr,
        )
        return getattr(stop, "exit_code", INTERRUPTED)
    except ImportError as error:
        if not _is_interrupt(error):
            raise
        print("gsbench: stopped; to continue, give the same command again", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output, such as `head`, has ended
        _drop_output()
        return DONE


def _command(argv: list[str]) -> int:
    if argv and argv[0] == "help":
        return _help([])
    if argv == ["--version"]:
        print(f"gsbench {__version__}")
        return DONE
    is_verb = argv and not set(argv[0][:1]) & set("-+~") and "=" not in argv[0]
    if set(HELP) & set(argv) and not is_verb:
        return _help([word for word in argv if word not in HELP])
    _require_current_folder()
    return _verb(argv[0], argv[1:]) if is_verb else _trials(argv)


def _drop_output() -> None:
    """Let nothing more be printed: Python would print the stream's error again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether a Ctrl-C caused an error, such as the ImportError of a half-loaded module."""
    return error is not None and (
        isinstance(error, KeyboardInterrupt) or _is_interrupt(error.__cause__ or error.__context__)
    )


def _refuse(error: GsbenchError, code: int) -> int:
    """Print an error as one line, also if it quotes line breaks or odd bytes; returns ``code``."""
    print(
        "gsbench: " + " ".join(str(error).split()).encode("utf-8", "backslashreplace").decode(),
        file=sys.stderr,
    )
    return code


def _require_current_folder() -> None:
    """Raise InputError if the current folder, in which paths start, was deleted."""
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"the current folder cannot be used ({error.strerror}), perhaps it was deleted: change "
            "to one that exists, or into it again if it was made anew"
        ) from None


def _verb(name: str, argv: list[str]) -> int:
    from gsbench.verbs import VERBS, load_verb  # here, for a quick start

    if name not in VERBS:
        from gsbench.config.groups import hint_for

        raise InputError(
            f"{name!r} is neither a verb nor a setting like key=value"
            f"{hint_for(name) or did_you_mean(name, VERBS)} (verbs: {', '.join(VERBS)})"
        )
    verb, runs = load_verb(name), checked_runs_folder(os.environ.get("GSBENCH_RUNS", "runs"))
    with storage_errors(runs):
        return verb(argv, runs)


USAGE = """\
gsbench tests whether an idea helps 3D Gaussian Splatting.

  gsbench scene=courtyard init=sfm densify=volumetric seed=0     one trial
  gsbench -m densify=adc,volumetric seed=0,1,2                   a sweep
  gsbench +experiment=demo                                       a sweep from a file
  gsbench scene=photos scene.path=/my/photos                     your own photographs
  gsbench +experiment=table1 --dry-run                           list the trials; run nothing
  gsbench --cfg job [settings]                                   show the configuration
  gsbench --version                                              say which gsbench this is
"""


def _trials(argv: list[str]) -> int:
    if not argv or argv in (["-m"], ["--multirun"]):
        print(USAGE + "\nEverything: gsbench --help")
        return DONE
    from gsbench.verbs.queries import QUERIES, ask_hydra

    if any(word.split("=")[0] in QUERIES for word in argv):
        return ask_hydra(argv)
    from gsbench.app.command import launch

    return launch(argv)


def _help(words: list[str]) -> int:
    from gsbench.config.groups import options_text
    from gsbench.verbs import VERBS

    folders: list[Path] = []
    if words:  # the choices in the user's folders are listed too
        from gsbench.config.command_words import parse
        from gsbench.config.search_path import searched_folders

        folders = searched_folders(parse(words)[0])
    print(USAGE)
    print("Verbs (gsbench VERB --help):")
    for name, row in VERBS.items():
        print(f"  {name:<10} {row['purpose']}")
    print("\n" + options_text(folders))
    return DONE


if __name__ == "__main__":
    main()
