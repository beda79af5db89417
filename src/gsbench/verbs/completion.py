"""``gsbench completion``: what the Tab key offers, as folders tell of experiments and trials, and Hydra of settings.

A shell's script asks ``gsbench completion query LINE``, which prints a line for each word that the last one of ``LINE``
may become. Loads no torch, and Hydra for settings only.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from gsbench.runs.experiments import list_experiments
from gsbench.runs.layout import SEED, TRIAL_GLOB
from gsbench.verbs.arguments import ArgumentParser
from gsbench.verbs.table import VERBS

QUERY = "query"
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
PLAIN_WORD = re.compile(r"[\w.,:=+/@\[\]{}~-]+")  # what no shell reads as anything but itself: folders have any names
CHOICES = r"(?<![\w-]){option}[ =]\{{([^}}]*)\}}"  # as argparse shows them: --format {{md,csv}}


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: print the script of a shell, or answer one."""
    if argv[:1] == [QUERY]:
        print("\n".join(complete(argv[1] if len(argv) > 1 else "", runs)))
        return 0
    parser = ArgumentParser(
        prog="gsbench completion",
        description="Print the script that lets a shell complete gsbench's verbs, settings, experiments and trials.",
        epilog="; ".join(f"{shell}: {line}" for shell, line in how_to_install().items()),
    )
    parser.add_argument("shell", choices=list(SCRIPTS))
    print(SCRIPTS[parser.parse_args(argv).shell])
    return 0


def complete(line: str, runs: Path) -> list[str]:
    """Complete the last word of a command ``line``: whole words in order; the line starts with the program."""
    words = line.split()[1:]
    word = words.pop() if words and not line[-1:].isspace() else ""
    if words and words[0] in VERBS:
        found = _of_verb(words[0], words[1:], word, runs)
    elif word.startswith("-"):
        from gsbench.config.command_words import OPTIONS

        found = list(OPTIONS)
    else:
        found = [*([] if words else VERBS), *_settings(words, word)]
    return sorted({candidate for candidate in found if candidate.startswith(word) and PLAIN_WORD.fullmatch(candidate)})


def _of_verb(verb: str, words: Sequence[str], word: str, runs: Path) -> Iterable[str]:
    """Words after a verb: options as its own help lists them, and what its arguments name."""
    if word.startswith("-"):
        return OPTION.findall(_help_of(verb, runs))
    if words and words[-1].startswith("--"):
        if choices := re.search(CHOICES.format(option=words[-1]), _help_of(verb, runs)):
            return choices.group(1).split(",")
        if words[-1] in ("--as", "--truth"):
            return _addresses(runs, word, whole=words[-1] == "--truth")
        if re.search(rf"(?<![\w-]){words[-1]} [A-Z]", _help_of(verb, runs)):
            return []  # a value of its own: a file, for which the shell has a better list
    given = [argument for argument in words if not argument.startswith("-")]
    match verb:
        case "tables" | "report" | "status" | "sync" | "ui":
            return [] if given else list_experiments(runs)
        case "retry":
            return _settings(given[1:], word) if given else list_experiments(runs)
        case "explain":
            return _settings(given, word) if "=" in word else _cells(word, runs)
        case "view" | "video":
            return _addresses(runs, word, whole=True)
        case "export":
            return [*([] if given else ["init"]), *_addresses(runs, word, whole=True)]
        case "fetch":
            from gsbench.datasets.catalog import read_catalog

            catalog = read_catalog()
            return catalog if not given else catalog[given[0]].scenes if given[0] in catalog else []
        case "completion":
            return [] if given else list(SCRIPTS)
    return []


def _help_of(verb: str, runs: Path) -> str:
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        importlib.import_module(VERBS[verb][0]).main(["--help"], runs)
    return text.getvalue()


def _cells(word: str, runs: Path) -> list[str]:
    """``EXPERIMENT:SCENE:METRIC:ARM``, a part at a time."""
    name, *rest = word.split(":")
    if not rest:
        return [f"{experiment}:" for experiment in list_experiments(runs)]
    if len(rest) == 1:
        return [f"{name}:{scene}:" for scene in {folder.parents[1].name for folder in _trials(runs, name)}]
    if len(rest) == 2:
        from gsbench.eval.facts import known_keys

        return [f"{name}:{rest[0]}:{metric}:" for metric in known_keys()]
    arms = {folder.parent.name for folder in _trials(runs, name) if folder.parents[1].name == rest[0]}
    return [f"{name}:{rest[0]}:{rest[1]}:{arm}" for arm in arms]


def _addresses(runs: Path, word: str, whole: bool) -> list[str]:
    """``EXPERIMENT:SCENE:ARM:SEED`` of the trials that are there, a part at a time; if not ``whole``, experiments."""
    depth = word.count(":")
    if not depth:
        return [f"{name}:" for name in list_experiments(runs)]
    name, found = word.split(":")[0], set()
    for folder in _trials(runs, name) if whole else []:
        scene, arm, seed = folder.parents[1].name, folder.parent.name, folder.name.rpartition(SEED)[2]
        found.add(":".join([name, scene, arm, seed][: depth + 1]) + (":" if depth < 3 else ""))
    return sorted(found)


def _trials(runs: Path, name: str) -> list[Path]:
    return list((runs / name).glob(TRIAL_GLOB)) if name in list_experiments(runs) else []


def _settings(words: Sequence[str], word: str) -> list[str]:
    """Groups, their choices and keys that may follow ``words``; of a list, the last value."""
    from gsbench.config.questions import settings_like

    return settings_like(words, word)


BASH = r"""
_gsbench() {
  local line="${COMP_LINE:0:COMP_POINT}" program="${COMP_WORDS[0]/#\~/$HOME}" found
  local word="${line##*[[:space:]]}" breaks="${COMP_WORDBREAKS//[^=:]/}" kept=""
  [[ -n $breaks ]] && kept="${word%"${word##*[$breaks]}"}"  # readline replaces what follows the last = or :
  COMPREPLY=()
  while IFS= read -r found; do
    [[ -n $found ]] && COMPREPLY+=("${found#"$kept"}")
  done < <("$program" completion query "$line" 2>/dev/null)
  [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *[=.:/] ]] && compopt -o nospace 2>/dev/null
  return 0
}
complete -o default -F _gsbench gsbench
"""

ZSH = r"""
_gsbench() {
  local -a found
  local program="${words[1]/#\~/$HOME}"
  found=("${(@f)$("$program" completion query "${(j: :)words[1,CURRENT-1]} $PREFIX" 2>/dev/null)}")
  found=(${found:#})
  if (( ! $#found )); then
    compset -P '*='
    _files
    return
  fi
  compadd -S '' -- ${(M)found:#*[=.:/]}
  compadd -- ${found:#*[=.:/]}
}
(( $+functions[compdef] )) || { autoload -Uz compinit && compinit -i; }
compdef _gsbench gsbench
"""

FISH = r"""
function __gsbench_complete
    set -l program (string replace -r '^~' $HOME (commandline -po)[1])
    set -l found ($program completion query (commandline -cp | string collect) 2>/dev/null | string match -v '')
    if test (count $found) -gt 0
        printf '%s\n' $found
        return
    end
    set -l setting (string match -r '^[^=]*=' -- (commandline -ct))
    for path in (__fish_complete_path (string replace -r '^[^=]*=' '' -- (commandline -ct)))
        printf '%s%s\n' "$setting" $path
    end
end
complete -c gsbench -f -a '(__gsbench_complete)'
"""

SCRIPTS = {"bash": BASH.strip(), "zsh": ZSH.strip(), "fish": FISH.strip()}


def how_to_install() -> dict[str, str]:
    """The one line for a shell's start-up file."""
    return {
        "bash": 'eval "$(gsbench completion bash)" in ~/.bashrc',
        "zsh": 'eval "$(gsbench completion zsh)" in ~/.zshrc',
        "fish": "gsbench completion fish | source in ~/.config/fish/config.fish",
    }
