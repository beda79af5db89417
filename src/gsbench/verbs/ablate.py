"""``gsbench ablate``: an experiment that shows which part of a densifier makes its gain."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from gsbench.app.command import compose_trials
from gsbench.claims import ablation
from gsbench.config.compose import Trial
from gsbench.config.overrides import value_text
from gsbench.errors import InputError
from gsbench.files import own_output, write_text
from gsbench.launch.batch import check_parts
from gsbench.verbs.arguments import ArgumentParser, names, path
from gsbench.words import command, counted

EXPERIMENT = """\
# @package _global_
# A study of {densify}: each combination of its parts against all of them.
# {summary}.
# As conf/experiment/{name}.yaml: gsbench --config-dir conf +experiment={name}
{content}"""


def ablate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0; raises InputError for bad input."""
    from gsbench.pipeline.parts import Parts  # here, for a quick answer to --help

    options = ArgumentParser(
        "ablate",
        "It writes an experiment with a grid for each combination (docs/claims.md).",
        {
            "settings* KEY=VALUE": "as of a sweep: densify=volumetric seed=0,1,2 …",
            "--switches A,B": ("only these; default: all declared", names, ()),
            "--out FILE": ("such as conf/experiment/parts.yaml; default: print it", path),
        },
    ).parse_args(argv)
    words = list(options.settings)
    if strange := [word for word in words if word.startswith(("~", "hydra.", "+experiment="))]:
        raise InputError(f"{strange[0]}: ablate writes an experiment, so give it plain KEY=VALUE")
    if not any(word.startswith("densify=") for word in words):
        raise InputError("ablate needs a densifier, such as densify=volumetric")
    first = compose_trials(words, multirun=True)
    densify, values = _only_densifier(first), first[0].values
    of_class = getattr(type(Parts(values).trainer), "SWITCHES", {})
    declared = ablation.declared_switches(of_class, values["densify"])
    switches = ablation.choose_switches(declared, options.switches, densify)
    grids = []
    for run in ablation.runs_to_train(switches):
        off = _settings(ablation.off_settings(run, switches), values["densify"])
        settings = [f"{key}={value}" for key, value in off.items()]
        check_parts(compose_trials([*words, *settings], multirun=True)[:1], on_this_machine=False)
        if off in grids:
            raise InputError(f"switching off {', '.join(off)} twice makes no other run")
        grids.append(off)
    given = {key: value for key, _, value in (word.partition("=") for word in words)}
    grids = [{"densify": given["densify"]} | off for off in grids]
    del given["densify"]
    name = given.pop("name", f"ablate_{densify}")
    content = {
        "name": name,
        "eval": {"baseline": densify},
        "hydra": {"mode": "MULTIRUN", "sweeper": {"params": given, "grids": grids}},
    }
    trials = len(first) * len(grids)
    text = EXPERIMENT.format(
        densify=densify,
        name=name,
        summary=f"{counted(len(switches), 'part')} ({', '.join(switches)}), {len(grids)} runs, "
        f"{counted(trials, 'trial')}",
        content=yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=100),
    )
    if options.out is None:
        print(text, end="")
        return 0
    with own_output(options.out):
        write_text(options.out, text)
    print(f"{options.out}: {counted(trials, 'trial')} of {command(f'+experiment={name}')}")
    return 0


def _only_densifier(trials: Sequence[Trial]) -> str:
    arms = {
        (trial.values["init"]["name"], trial.values["densify"]["name"], trial.files.home)
        for trial in trials
    }
    places = {(trial.values["scene"]["name"], trial.values["seed"]) for trial in trials}
    if len(arms) > 1 or len(places) < len(trials):
        raise InputError(
            "ablate needs one initialiser and one densifier: only scene and seed may list values"
        )
    return str(trials[0].values["densify"]["name"])


def _settings(off: dict[str, Any], densify: dict[str, Any]) -> dict[str, str]:
    """The settings that turn parts off; a key that the densifier lacks needs Hydra's plus."""
    return {
        f"{'' if key in densify else '+'}densify.{key}": value_text(value)
        for key, value in off.items()
    }
