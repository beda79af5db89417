"""``gsbench check``: a paper's claims in, verdicts out."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from gsbench.claims.file import ClaimsFile, direction_is_odd, read_claims
from gsbench.claims.here import Here
from gsbench.claims.recheck import check_can_go_on, judged, recheck, with_shares
from gsbench.claims.shares import Shares, check_plan_keeps, read_shares
from gsbench.claims.sweep import Check, prepare, run_looks
from gsbench.config.compose import TrialConfig
from gsbench.config.trust import PERMISSIONS
from gsbench.errors import InputError
from gsbench.files import make_runs_folder, place_of, write_text
from gsbench.launch.declare import declare_plan
from gsbench.launch.plan import describe_plan
from gsbench.launch.preflight import missing_folders
from gsbench.launch.trial import Trial
from gsbench.runs.declaration import CLAIMS, read_plans, standing_plan
from gsbench.runs.trial_folder import TrialFolder
from gsbench.verbs.arguments import ArgumentParser, names, path
from gsbench.words import counted

MARKDOWN, HTML = "claims.md", "claims.html"
PAGE_ENDINGS = (".md", ".html")


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 whatever the verdicts are; raises InputError for bad input."""
    parser = ArgumentParser(
        prog="gsbench check",
        description="Test the claims of a file (docs/claims.md): write the plan down, run trials until each claim is "
        "decided, and write a page with the verdicts.",
    )
    parser.add_argument("claims", type=path, help="a YAML file, such as conf/claims/volumetric.yaml")
    parser.add_argument(
        "permissions",
        nargs="*",
        metavar="allow_targets=[MINE]",
        help="what the claims' arms may run beside gsbench; a file of claims cannot allow it",
    )
    parser.add_argument("--dry-run", action="store_true", help="show trials, time and what is not testable here")
    parser.add_argument(
        "--from",
        dest="archives",
        type=path,
        nargs="+",
        action="extend",
        metavar="ARCHIVE",
        help="make the verdicts again from what gsbench export --results wrote; runs nothing, needs no photographs",
    )
    parser.add_argument(
        "--with",
        dest="shares",
        type=path,
        nargs="+",
        action="extend",
        default=[],
        metavar="ARCHIVE",
        help="archives of the same check, from other machines or of an earlier day: what they hold is not run again",
    )
    parser.add_argument(
        "--scene",
        dest="scenes",
        type=names,
        action="extend",
        default=[],
        metavar="NAME,…",
        help="run the trials of these scenes alone, where other machines run the others",
    )
    parser.add_argument(
        "--all-seeds",
        action="store_true",
        help="run all planned seeds at once, where looks at the trials would wait for other machines",
    )
    parser.add_argument("--out", type=path, metavar="PAGE", help="with --from: write the whole page, as .md or .html")
    options = parser.parse_args(argv)
    file = read_claims(options.claims)
    if options.archives is not None:
        if options.dry_run or options.shares or options.scenes or options.all_seeds:
            raise InputError("check --from runs nothing, so no other option than --out goes with it")
        return _recheck(file, options.archives, _permissions(options.permissions), options.out)
    if options.out is not None:
        raise InputError(f"--out goes with --from; what is run here writes {MARKDOWN} and {HTML} beside its trials")
    here = Here(missing_folders, download=not options.dry_run)
    check = prepare(file, runs, here, _permissions(options.permissions), options.scenes)
    with tempfile.TemporaryDirectory() as folder:
        shares = read_shares(options.shares, Path(folder), file.name) if options.shares else None
        if shares is not None:
            check = with_shares(check, shares)
            if ours := read_plans(check.home, CLAIMS):
                check_plan_keeps(ours[-1], shares.declared, "the archives")
        check_can_go_on(check, here.fingerprint)
        if options.dry_run:
            print("\n".join(describe(check)))
        else:
            _run(check, options.shares, shares, options.all_seeds)
    return 0


def _recheck(file: ClaimsFile, archives: Sequence[Path], permissions: Sequence[str], out: Path | None) -> int:
    """Print the verdicts that the archives' trials make, and write their page; 0 whatever the verdicts are.

    Raises InputError for an ``out`` of neither format.
    """
    from gsbench.claims.page import make_page, to_html, to_markdown, to_text

    if out is not None and out.suffix not in PAGE_ENDINGS:
        raise InputError(f"--out {out}: a page ends in {' or '.join(PAGE_ENDINGS)}")
    with tempfile.TemporaryDirectory() as folder:
        found = recheck(file, archives, Path(folder), permissions)
        page = make_page(file, found.verdicts, found.declared, found.plans)
        print(to_text(page), end="")
        if out is None:
            print("What each verdict rests on is on the whole page: --out PAGE.html (or .md)")
        else:
            with place_of(out):
                write_text(out, to_html(page) if out.suffix == ".html" else to_markdown(page))
            print(out)
    return 0


def _permissions(words: Sequence[str]) -> Sequence[str]:
    """The words after the file, which can only be permissions. Raises InputError for others."""
    for word in words:
        if word.split("=")[0] != PERMISSIONS:
            raise InputError(f"{word}: settings of a check stand in its file of claims; here only {PERMISSIONS}=[…]")
    return words


def describe(check: Check) -> list[str]:
    """Describe a dry run: each claim with its question or why it is not testable, the trials, and the time."""
    lines = [f"{check.file.paper}: plan {check.plan_hash[:12]}"]
    for question in check.questions:
        claim = question.claim
        if not question.testable:
            lines.append(f"not testable here  {claim.id}: {question.why_not}")
            continue
        asked = f"{claim.metric} of {claim.arm} against {claim.baseline}: {claim.direction}, by {claim.effect} at least"
        scenes = ", ".join(question.scenes)
        looks = ", ".join(map(str, check.looks))
        lines.append(f"to be tested       {claim.id}: {asked}; on {scenes}; looks at {looks} seeds")
        lines += [f"                   without {reason}" for reason in question.missing]
        if others := [scene for scene in question.scenes if (claim.id, scene) not in check.run_here]:
            lines.append(f"                   left to others: {', '.join(others)}")
        lines += [f"                   {remark}" for remark in [direction_is_odd(claim)] if remark]
    if shared := check.shared_pairs():
        lines.append(f"{counted(shared, 'pair')} of trials come from archives and are not run again")
    first, most = (check.trials(check.questions, seeds) for seeds in (check.looks[0], check.looks[-1]))
    lines.append(
        f"{counted(len(first), 'trial')} until the first look, {len(most)} at most; "
        f"each test may err in {100 * check.file.error_rate / check.sharing:.3g} % of such sweeps"
    )
    if most:
        lines += describe_plan([Trial.of(trial) for trial in most], most[0].values["launch"]["parallel"])
    return lines


def _run(check: Check, archives: Sequence[Path], shares: Shares | None, all_seeds: bool) -> None:
    from gsbench.claims.page import make_page, to_html, to_markdown
    from gsbench.launch.batch import run_batch

    make_runs_folder(check.runs)
    declared = declare_plan(check.home, check.plan, check.plan_hash, check.missing)
    plans = read_plans(check.home, CLAIMS)
    if shares is not None:  # the plan is as old as its oldest record, where no other one stood since
        plans = sorted((*plans, *shares.plans), key=lambda plan: plan.time)
        declared = standing_plan(plans)

    def is_done(trial: TrialConfig) -> bool:
        return not TrialFolder.of(trial.values).why_not_done(trial.values)

    def run(trials: Sequence[TrialConfig]) -> None:
        run_batch([Trial.of(trial) for trial in trials])

    if all_seeds and (left := [one for one in check.trials(check.questions, check.looks[-1]) if not is_done(one)]):
        run(left)  # what an earlier look sees does not change by them
    verdicts = judged(run_looks(check, declared, run, is_done))
    page = make_page(check.file, verdicts, declared, plans, [file.name for file in archives])
    for name, text in ((MARKDOWN, to_markdown(page)), (HTML, to_html(page))):
        write_text(check.home / name, text)
    for verdict in verdicts:
        print(f"{verdict.word:<17}  {verdict.claim.id}: {verdict.reason}")
    print(check.home / HTML)
