"""``gsbench check``: the claims of a paper, written in a file, are tested (docs/claims.md)."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from gsbench.analysis.notes import texts
from gsbench.claims.check import Check, prepare, recheck
from gsbench.claims.check_page import make_page, to_html, to_text
from gsbench.claims.file import ClaimsFile, read_claims
from gsbench.claims.stopping import KeyAndSeed, sequential_test
from gsbench.errors import InputError
from gsbench.files import make_runs_folder, writable_output, write_text
from gsbench.launch.batch import missing_folders, run_batch
from gsbench.launch.dry_run import describe_plan
from gsbench.launch.record import declare_questions
from gsbench.runs.user_code import PERMISSIONS
from gsbench.verbs.arguments import ArgumentParser, path
from gsbench.words import counted

HTML = "claims.html"


def check(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 whatever the verdicts are; raises InputError for bad input."""
    parser = ArgumentParser(
        "check", "It runs trials until each claim is decided, and writes a page (docs/claims.md)."
    )
    parser.add_argument(
        "claims", type=path, help="a YAML file, such as conf/claims/volumetric.yaml"
    )
    parser.add_argument(
        "permissions",
        nargs="*",
        default=[],
        metavar="allow_targets=[MINE]",
        help="what the claims' arms may run beside gsbench; a file of claims cannot allow it",
    )
    parser.flag("--dry-run", "show trials, time and what is not testable here")
    parser.add_argument(
        "--from",
        dest="archive",
        type=path,
        metavar="ARCHIVE",
        help="make the verdicts again from what gsbench export --results wrote; runs nothing, "
        "needs no photographs",
    )
    parser.add_argument(
        "--out", type=path, metavar="PAGE", help="with --from: write the whole page, a .html file"
    )
    options = parser.parse_args(argv)
    file = read_claims(options.claims)
    if options.archive is not None:
        if options.dry_run:
            raise InputError(
                "check --from runs nothing, so no other option than --out goes with it"
            )
        _recheck(file, options.archive, options.out)
        return 0
    if options.out is not None:
        raise InputError(
            f"--out goes with --from; what is run here writes {HTML} beside its trials"
        )
    check = prepare(file, runs, missing_folders, _permissions(options.permissions))
    if options.dry_run:
        print("\n".join(describe(check)))
    else:
        _run(check)
    return 0


def _recheck(file: ClaimsFile, archive: Path, out: Path | None) -> None:
    """Print the verdicts by the archive's trials, and write their page to ``out`` if given.

    Raises InputError for an ``out`` of another format.
    """
    if out is not None and out.suffix != ".html":
        raise InputError(f"--out {out}: a page ends in .html")
    with tempfile.TemporaryDirectory() as folder:
        page = make_page(recheck(file, archive, Path(folder)))
        print(to_text(page), end="")
        if out is None:
            print("The whole page says what each verdict rests on: --out PAGE.html")
        else:
            with writable_output(out):
                write_text(out, to_html(page))
            print(out)


def _permissions(words: Sequence[str]) -> Sequence[str]:
    """The words after the file. Raises InputError for words that are no permissions."""
    for word in words:
        if word.split("=")[0] != PERMISSIONS:
            raise InputError(
                f"{word}: settings of a check are in its file of claims; here only "
                f"{PERMISSIONS}=[…]"
            )
    return words


def describe(check: Check) -> list[str]:
    """The lines of a dry run: each claim's question or why it is not testable, trials, and time."""
    file, declaration = check.file, check.declaration
    questions = {question.name: question for question in declaration.questions}
    lines = [f"{file.paper}: {counted(len(questions), 'claim')} to be tested"]
    for claim in file.claims:
        missing = declaration.missing.get(claim.id, [])
        if claim.id not in questions:
            why = claim.not_testable or "; ".join(missing)
            lines.append(f"not testable here  {claim.id}: {why}")
            continue
        scenes = ", ".join(questions[claim.id].scenes)
        looks = ", ".join(map(str, declaration.looks))
        lines.append(
            f"to be tested       {claim.id}: {claim.metric} of {claim.arm} against "
            f"{claim.baseline}: {claim.direction}, by {claim.effect} at least; on {scenes}; "
            f"looks at {looks} seeds"
        )
        lines += [f"                   without {reason}" for reason in missing]
    if not questions:
        return lines
    first, most = check.trials(declaration.looks[0]), check.trials(declaration.looks[-1])
    lines.append(
        f"{counted(len(first), 'trial')} until the first look, {len(most)} at most; "
        f"each test may err in {100 * file.error_rate / len(questions):.3g} % of such sweeps"
    )
    if most:
        lines += describe_plan(most, most[0].values["launch"]["parallel"])
    return lines


def _run(check: Check) -> None:
    make_runs_folder(check.runs)
    check = replace(check, declaration=declare_questions(check.home, check.declaration))

    def run(planned: Sequence[KeyAndSeed]) -> None:
        unfinished = [
            trial for trial in check.to_run(planned) if trial.files.why_not_done(trial.values)
        ]
        if unfinished:
            run_batch(unfinished)

    checked = check.checked(sequential_test(check).answer(run))
    write_text(check.home / HTML, to_html(make_page(checked)))
    for verdict in checked.verdicts:
        print(f"{verdict.word:<19}  {verdict.claim.id}: {verdict.sentence}")
    for note in texts(checked.unused):
        print(note)
    print(check.home / HTML)
