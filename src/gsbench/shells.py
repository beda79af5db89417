"""The scripts by which shells ask ``gsbench completion query``."""

from __future__ import annotations

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
