"""Write ``findings/tables.md``, the verdicts in ``findings/README.md`` and a picture, all from
``findings/archives``.

    python findings/scripts/tables.py

Verdicts are those of the questions that the archives declare, as ``gsbench site`` shows them.
All other tables describe the same trials by pandas and SciPy alone, without gsbench's own
statistics. Nobody declared those: an interval is Student's of 95 % for one mean, and is not
adjusted for the number of intervals beside it.
"""

from __future__ import annotations

import functools
import json
import re
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import stats

from gsbench.analysis.fairness import EQUAL_COUNTS
from gsbench.analysis.verdicts import Verdict, judge
from gsbench.claims.archive import unpack_archive
from gsbench.words import counted, signed

FINDINGS = Path(__file__).parents[1]
ARCHIVES = FINDINGS / "archives"
README, TABLES = FINDINGS / "README.md", FINDINGS / "tables.md"

LPIPS = "lpips_squeeze"
METRICS = {
    LPIPS: ("LPIPS", 3),
    "psnr": ("PSNR, dB", 2),
    "ssim": ("SSIM", 3),
    "ms_ssim": ("MS-SSIM", 4),
}
METRICS |= {"fsim": ("FSIMc", 4), "flip": ("FLIP", 3)}
SPLITS = {
    "interpolation": "between",
    "extrapolation": "sector",
}  # as the page calls what a split asks
GROWTH = ("event_split_volume", "event_split_gradient", "event_cloned")
CAPTURE_FACTS = {
    "points_per_pixel": "points by pixels of all views",
    "camera_distance": "distance of points to the nearest camera, extents",
    "depth_spread": "spread of depths in a view",
    "texture": "texture, mean slope of grey values",
    "camera_angle": "angle to the nearest camera",
}
FEWEST_SCENES = (
    6  # from here on the scenes are the units of an interval, below it the pairs of trials
)
KEYS = ["split", "scene", "seed"]  # of a pair of trials

# The claims of the paper's rule, in the README's table: archive, claim, what was asked of LPIPS.
ASKED = [
    ("plants", "plants_between_cameras", "**plants**, 20,000 Gaussians each, between the cameras"),
    ("plants", "plants_where_no_camera_went", "plants, a sector of neighbouring cameras held out"),
    ("plants", "others_between_cameras", "no plants, between the cameras (claimed: within 0.010)"),
    ("plants", "others_where_no_camera_went", "no plants, sector (claimed: within 0.010)"),
    (
        "volume",
        "rule_between_cameras",
        "the paper's rule, 20,000 Gaussians each, views between the cameras",
    ),
    ("volume", "rule_where_no_camera_went", "the same, a sector of neighbouring cameras held out"),
    ("volume", "once_between_cameras", "without runaway splits, between the cameras"),
    ("volume", "once_where_no_camera_went", "without runaway splits, sector"),
    ("dimension", "rule_between_cameras", "more of the rule, between the cameras"),
    ("dimension", "rule_where_no_camera_went", "more of the rule, sector"),
    ("dimension", "once_between_cameras", "more of it without runaway splits, between the cameras"),
    ("dimension", "once_where_no_camera_went", "more of it without runaway splits, sector"),
    ("schedule", "plants", "`lewis` (plants), 30,000 iterations, 20,000 Gaussians each"),
    ("schedule", "no_plants", "`horns` (no plants), the same"),
    ("full", "one_count", "30,000 iterations, 40,000 Gaussians each"),
    ("full", "lower_lpips", "30,000 iterations, each growing up to 100,000"),
    ("full", "lower_lpips_once", "the same, without runaway splits"),
    ("full_count", "once_at_as_many", "the same, against adc with as many Gaussians"),
    ("paper", "lower_lpips", "160 px, 2,000 iterations, each growing up to 30,000"),
]


def ideas_table(name: str) -> str:
    """A ledger of gsbench 0.1, which later versions no longer read, and its confirmation."""
    with zipfile.ZipFile(ARCHIVES / f"{name}.zip") as archive:
        content = archive.read("ledger.jsonl").decode()
    opened, *entries = (json.loads(line)["entry"] for line in content.splitlines())
    ended = {one["idea"]: one for one in entries if one["kind"] == "ended"}
    started = [one for one in entries if one["kind"] == "started"]
    kept = sum(one["result"] == "kept" for one in ended.values())
    lines = [
        f"{opened['metric']} decides: less is better, and {opened['least']} is the least that "
        f"matters. At most {100 * opened['rate']:g} % of the kept ideas are expected to be no "
        "better.",
        f"{len(started)} of {opened['ideas']} planned ideas were tried, and {kept} kept, on "
        f"{', '.join(opened['keys'])}, with at most {len(opened['seeds'])} seeds.",
        "\n### Ideas in their order\n",
        "| idea | against | level | seeds | difference | Gaussians | time | result | why |",
        "| :--- |" + " ---: |" * 8,
    ]
    for number, one in enumerate(started, 1):
        end = ended[one["idea"]]
        why, ratio = end["reason"], end["gaussians"]
        if abs(ratio - 1) > EQUAL_COUNTS:
            why += f"; with {ratio:.2f} times the Gaussians, so not at equal counts"
        lines.append(
            f"| {number} {one['idea']} | {one['against']} | {one['level']:.2g} | {end['seeds']} | "
            f"{_with_interval(end.get('difference'))} | ×{ratio:.2f} | ×{end['seconds']:.2f} | "
            f"{end['result']} | {why} |"
        )
    lines.append(
        "\n- level: the chance that this test keeps an idea that is no better. All levels follow "
        "from the share above; each kept idea raises those after it.\n"
    )
    asked, found = entries[-2:]
    lines += [
        f"### Confirmation on {', '.join(asked['keys']['baseline'])} with {len(asked['seeds'])} "
        f"seeds ({asked['time'][:16].replace('T', ' ')} UTC)\n",
        "| idea | difference from the baseline | result |",
        "| :--- | ---: | ---: |",
    ]
    lines += [
        f"| {idea} | {_with_interval(found['differences'][idea])} | {result} |"
        for idea, result in found["results"].items()
    ]
    return "\n".join(lines) + "\n"


def p_text(p: float) -> str:
    """``below 0.001``, or p with three decimals."""
    return "below 0.001" if p < 0.001 else f"{p:.3f}"


def _with_interval(difference: dict[str, float] | None) -> str:
    if difference is None:
        return ""
    mean, low, high = (signed(difference[key], ".4g") for key in ("mean", "low", "high"))
    return f"{mean} ({low} to {high})"


def read_trials(name: str) -> pd.DataFrame:
    """The trials of an archive, a row each: ``arm``, ``split``, settings by dotted key, metrics,
    counts, events."""
    with zipfile.ZipFile(ARCHIVES / f"{name}.zip") as archive:
        lines = pd.read_json(archive.open("results.jsonl"), lines=True)
        configurations = pd.read_json(archive.open("configurations.jsonl"), lines=True)
    results = pd.json_normalize(lines.results.tolist())
    results.columns = [
        re.sub("^metrics[.]", "", key).replace("events.", "event_") for key in results.columns
    ]
    settings = {
        folder: values["scene"] | values["train"] | values["densify"]
        for values, trials in zip(configurations.configuration, configurations.trials, strict=True)
        for folder, _ in trials
    }
    rows = [settings[folder] for folder in lines.folder]
    shown = {
        key: [row.get(key) for row in rows]
        for key in ("max_size", "iterations", "max_gaussians", "cap")
    }
    splits = ["extrapolation" if row["split"] == "sector" else "interpolation" for row in rows]
    results = results.drop(columns="split").assign(**shown, split=splits, trial=lines.folder)
    return with_arms(results)


def with_arms(frame: pd.DataFrame) -> pd.DataFrame:
    """Add the column ``arm``: the densifier, or the initialiser where those differ."""
    return frame.assign(arm=frame.init if frame.densify.nunique() == 1 else frame.densify)


def differences(frame: pd.DataFrame, arm: str, against: str, metric: str) -> pd.Series:
    """``arm`` minus ``against``, by split, scene and seed; what one of both lacks is left out."""
    own = frame.assign(split=frame.get("split", "interpolation"))
    one, other = (own[own.arm == name].set_index(KEYS)[metric] for name in (against, arm))
    return (other - one).dropna().sort_index()


def mean_with_interval(values: Sequence[float] | pd.Series, digits: int) -> str:
    """The mean and, of two values and more, Student's interval of 95 %."""
    mean = signed(float(np.mean(values)), f".{digits}f")
    if len(values) < 2:
        return mean
    interval = stats.ttest_1samp(np.asarray(values, float), 0).confidence_interval()
    return (
        f"{mean} ({signed(interval.low, f'.{digits}f')} to {signed(interval.high, f'.{digits}f')})"
    )


def over_scenes(found: pd.Series, digits: int) -> str:
    """The mean over scenes; its interval is over the scenes from `FEWEST_SCENES` on, else over the
    pairs."""
    scenes = found.groupby("scene").mean()
    return mean_with_interval(scenes if len(scenes) >= FEWEST_SCENES else found, digits)


def in_order(arms: pd.Series) -> list[str]:
    """The arms, those that others are held against first."""
    first = ("adc", "absgrad", "sfm")
    return sorted(
        dict.fromkeys(arms), key=lambda arm: first.index(arm) if arm in first else len(first)
    )


def table(titles: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of Markdown, whose columns but the first stand to the right."""
    lines = [titles, ["---", *["--:"] * (len(titles) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


@functools.cache
def verdicts(name: str) -> dict[str, Verdict]:
    """The verdicts on the declared claims of ``NAME.zip``, by claim."""
    with tempfile.TemporaryDirectory() as folder:
        experiment = unpack_archive(ARCHIVES / f"{name}.zip", Path(folder))
        trials = [*experiment.trials, *experiment.older]
        return {
            question.name: judge(trials, question, experiment.unfinished)
            for question in experiment.history.questions
            if question.name
        }


def verdict_cells(verdict: Verdict) -> list[str]:
    """The difference with its interval, the verdict, and what it rests on."""
    word = verdict.outcome if verdict.untestable is None else "not testable"
    if verdict.mean is None or verdict.interval is None:
        return ["", f"**{word}**", ""]
    shown = f"{verdict.shown(verdict.mean)} ({verdict.shown_interval(verdict.interval)})"
    level = f"{100 * (1 - verdict.level):.3g} %"
    on = f"{counted(len(verdict.scenes), 'scene')}, {counted(verdict.pairs.seeds, 'seed')}, {level}"
    if verdict.like_these is not None:
        on += f"; lower in {verdict.like_these.helped} of {verdict.like_these.scenes}"
    return [shown, f"**{word}**", on]


def difference_of(verdict: Verdict) -> str:
    """The idea minus the baseline, by that of densifier and initialiser in which they differ."""
    arms = (verdict.question.idea, verdict.question.baseline)
    differ = arms[0].densify != arms[1].densify
    return " − ".join(arm.densify if differ else arm.init for arm in arms)


def answers() -> str:
    """The README's table: a claim about the rule a row."""
    rows = [[asked, *verdict_cells(verdicts(name)[claim])] for name, claim, asked in ASKED]
    return table(
        ["LPIPS of the rule minus LPIPS of adc", "difference (interval)", "verdict", "on"], rows
    )


def claims_table(name: str) -> str:
    """A claim a row."""
    rows = [
        [f"`{v.question.name}`: {difference_of(v)}", *verdict_cells(v)]
        for v in verdicts(name).values()
    ]
    return table(["claim", "difference (interval)", "verdict", "on"], rows)


def scenes_table(name: str, arms: Sequence[str], against: str = "adc") -> str:
    """LPIPS, ``arm`` minus ``against``: a scene a row with its interval over the seeds, last the
    mean over scenes."""
    frame = read_trials(name)
    found = {arm: differences(frame, arm, against, LPIPS) for arm in arms}
    columns = [(split, arm) for split in SPLITS if split in set(frame.split) for arm in arms]
    rows = [
        [str(scene), *(_scene_cell(found[arm], split, scene) for split, arm in columns)]
        for scene in sorted(set(frame.scene))
    ]
    means = [over_scenes(found[arm].loc[split], 3) for split, arm in columns]
    return table(
        ["scene", *(f"{arm}, {SPLITS[split]}" for split, arm in columns)],
        [*rows, ["*mean*", *means]],
    )


def _scene_cell(found: pd.Series, split: str, scene: str) -> str:
    """A scene's mean difference; "" where the scene was not split so."""
    return (
        mean_with_interval(found.loc[split, scene], 3)
        if (split, scene) in found.index.droplevel("seed")
        else ""
    )


def metrics_table(name: str, arms: Sequence[str], against: str = "adc") -> str:
    """Means over scenes of ``arm`` minus ``against`` in all metrics, by what the split asks."""
    return _metrics(read_trials(name), arms, against)


def _metrics(frame: pd.DataFrame, arms: Sequence[str], against: str) -> str:
    shown = {metric: facts for metric, facts in METRICS.items() if metric in frame}
    rows = []
    for split in SPLITS if "split" in frame else ["interpolation"]:
        for arm in arms:
            found = {metric: differences(frame, arm, against, metric) for metric in shown}
            if split in found[LPIPS].index.get_level_values("split"):
                cells = [
                    over_scenes(found[metric].loc[split], shown[metric][1]) for metric in shown
                ]
                rows.append(
                    [
                        f"{arm} − {against}" + (f", {SPLITS[split]}" if "split" in frame else ""),
                        *cells,
                    ]
                )
    return table(["", *(title for title, _ in shown.values())], rows)


def shares_table(name: str, arms: Sequence[str]) -> str:
    """A scene a row: of all that is split or cloned, the share that is split by volume, over seeds
    and splits."""
    frame = read_trials(name)
    counts = frame.groupby(["scene", "arm"])[list(GROWTH)].sum()
    shares = (
        (counts[GROWTH[0]] / counts.sum(axis=1))
        .unstack()[list(arms)]
        .sort_values(arms[0], ascending=False)
    )
    points = frame.groupby("scene").num_init_points.mean()
    rows = [
        [str(s), f"{points[s]:,.0f}", *(f"{value:.2f}" for value in row)]
        for s, row in shares.iterrows()
    ]
    return table(["scene", "initial points", *arms], rows)


def correlations_table(names: Sequence[str], arm: str = "volumetric") -> str:
    """A fact a row: over the scenes of all archives, Spearman's correlation of LPIPS minus adc's
    with it, by split.

    What captures are like is measured by ``scenes.py``; the courtyard is none.
    """
    captures = pd.read_csv(ARCHIVES / "scenes.csv", index_col="scene")[list(CAPTURE_FACTS)]
    columns = []
    facts_shown = {"share": "share split by volume", "points": "initial points", **CAPTURE_FACTS}
    for split, word in SPLITS.items():
        facts = []
        for name in names:
            frame = read_trials(name)
            own = frame[(frame.arm == arm) & (frame.split == split)]
            by_scene = own.groupby("scene")[[*GROWTH, "num_init_points"]].sum()
            change = differences(frame, arm, "adc", LPIPS).loc[split].groupby("scene").mean()
            share = by_scene[GROWTH[0]] / by_scene[list(GROWTH)].sum(axis=1)
            facts.append(
                pd.DataFrame(
                    {
                        "change": change,
                        "share": share,
                        "points": own.groupby("scene").num_init_points.mean(),
                    }
                )
            )
        joined = pd.concat(facts).join(captures)
        cells = []
        for key in facts_shown:
            own = joined[["change", key]].dropna()
            one = stats.spearmanr(own.change, own[key])
            cells.append(
                f"{signed(one.statistic, '.2f')} (p {p_text(one.pvalue)}, {len(own)} scenes)"
            )
        columns.append((word, cells))
    rows = [
        [title, *(cells[k] for _, cells in columns)] for k, title in enumerate(facts_shown.values())
    ]
    return table(["LPIPS of the rule minus adc's goes with", *(word for word, _ in columns)], rows)


def views_table(name: str) -> str:
    """A scene a row: its held-out views under both splits, how far the nearest training view is,
    and adc's PSNR."""
    with zipfile.ZipFile(ARCHIVES / f"{name}.zip") as archive:
        views = pd.read_csv(archive.open("per_view.csv"))
    frame = read_trials(name)
    frame = frame[frame.arm == "adc"].merge(views, on="trial", suffixes=("", "_of_view"))
    by = frame.groupby(["scene", "split"])
    psnr = frame.groupby(["scene", "split", "seed"]).psnr.first().groupby(["scene", "split"]).mean()
    columns = {
        "views": by.view.nunique().map(str),
        "angle": by.angle_to_nearest.median().map("{:.1f}°".format),
        "distance": by.distance_to_nearest.median().map("{:.2f}".format),
        "adc's PSNR": psnr.map("{:.2f}".format),
    }
    rows = [
        [
            str(scene),
            *(column.get((scene, split), "") for column in columns.values() for split in SPLITS),
        ]
        for scene in sorted(set(frame.scene))
    ]
    return table(
        ["scene", *(f"{title}, {word}" for title in columns for word in SPLITS.values())], rows
    )


def budgets_table(name: str, arms: Sequence[str], against: str = "adc") -> str:
    """A budget of a scene and an arm a row: means over the seeds, and LPIPS minus that of
    ``against``.

    By volume: the share of what grows that is split by volume. Held back: how often the cap did not
    let one grow.
    """
    frame = read_trials(name)
    grown = frame[list(GROWTH)].sum(axis=1)
    frame = frame.assign(share=frame[GROWTH[0]] / grown)
    columns = {
        "num_gaussians": ("Gaussians", 0),
        "event_blocked_by_cap": ("held back", 0),
        "share": ("by volume", 2),
    }
    columns |= {key: METRICS[key] for key in ("psnr", "ssim", LPIPS)}
    rows = []
    for (scene, most, cap), own in frame.groupby(["scene", "max_gaussians", "cap"]):
        for arm in (against, *arms):
            means = own[own.arm == arm][list(columns)].mean()
            cells = [f"{means[key]:,.{digits}f}" for key, (_, digits) in columns.items()]
            last = (
                ""
                if arm == against
                else mean_with_interval(differences(own, arm, against, LPIPS), 3)
            )
            rows.append([f"{scene}, {most:,} ({cap})", arm, *cells, last])
    return table(
        ["budget", "arm", *(title for title, _ in columns.values()), f"LPIPS − {against}"], rows
    )


def arms_table(name: str, against: Mapping[str, str], scenes: Sequence[str] = ()) -> str:
    """A row per scene (default: all) and arm: means over the seeds, and the differences from the
    arm that ``against`` names; views between the cameras."""
    frame = read_trials(name)
    frame = frame[(frame.split == "interpolation") & (frame.scene.isin(scenes) if scenes else True)]
    columns = {"num_gaussians": ("Gaussians", 0)} | {
        key: METRICS[key] for key in ("psnr", "ssim", LPIPS)
    }
    asked = ("psnr", LPIPS)
    found = {
        arm: [differences(frame, arm, other, key) for key in asked]
        for arm, other in against.items()
    }
    rows = []
    for scene, own in frame.groupby("scene"):
        points = f"{own.num_init_points.mean():,.0f}"
        for arm in dict.fromkeys([*against.values(), *against]):
            means = own[own.arm == arm][list(columns)].mean()
            cells = [f"{means[key]:,.{digits}f}" for key, (_, digits) in columns.items()]
            last = [
                mean_with_interval(change.xs(scene, level="scene"), METRICS[key][1])
                for key, change in zip(asked, found.get(arm, ()), strict=False)
            ]
            rows.append(
                [f"{scene}, {points}", arm, *cells, against.get(arm, ""), *(last or ["", ""])]
            )
    titles = [title for title, _ in columns.values()]
    return table(
        ["scene, initial points", "arm", *titles, "minus", *(METRICS[key][0] for key in asked)],
        rows,
    )


def clouds_table(name: str) -> str:
    """An initialiser a row: points of its cloud, LPIPS and PSNR in each scene and on average, means
    over the seeds."""
    frame = read_trials(name)
    columns = {"num_init_points": ",.0f", LPIPS: ".3f", "psnr": ".2f"}
    by_scene = frame.groupby(["arm", "scene"])[list(columns)].mean()
    rows = []
    for arm in in_order(frame.arm):
        means = [row for _, row in by_scene.loc[arm].iterrows()] + [by_scene.loc[arm].mean()]
        rows.append(
            [
                arm,
                *(
                    "; ".join(f"{own[key]:{form}}" for key, form in columns.items())
                    for own in means
                ),
            ]
        )
    return table(["initial points; LPIPS; PSNR, dB", *sorted(set(frame.scene)), "*mean*"], rows)


def sizes_table(arm: str, against: str, name: str = "scale_bridge") -> str:
    """A size of picture or a length of training a row: ``arm`` minus ``against`` as mean of the
    scenes, and LPIPS of each scene.
    """
    frame = read_trials(name)
    scenes = sorted(set(frame.scene))
    rows = []
    for label, own in by_size(frame):
        found = {
            metric: differences(own, arm, against, metric) for metric in (LPIPS, "psnr", "ssim")
        }
        by_scene = found[LPIPS].groupby("scene").mean()
        cells = [over_scenes(found[metric], METRICS[metric][1]) for metric in found]
        rows.append([label, *cells, *(signed(by_scene[scene], ".3f") for scene in scenes)])
    return table(["", "LPIPS", "PSNR, dB", "SSIM", *(f"LPIPS, {scene}" for scene in scenes)], rows)


def by_size(frame: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """The trials at each size (5,000 iterations), then at each length (256 px), with its name."""
    size = frame.max_size
    sizes = [
        (f"{px} px", frame[(size == px) & (frame.iterations == 5000)]) for px in sorted(set(size))
    ]
    lengths = sorted(set(frame.iterations))
    return sizes + [
        (f"{n:,} iterations", frame[(size == 256) & (frame.iterations == n)]) for n in lengths
    ]


def first_table(name: str) -> str:
    """An arm a row: means over scenes and seeds; ± is the deviation over seeds of the mean over
    scenes."""
    frame = with_arms(pd.read_csv(ARCHIVES / "first" / f"{name}.csv"))
    columns = {"num_gaussians": ("Gaussians", 0)}
    columns |= {key: METRICS[key] for key in (LPIPS, "psnr", "ssim", "flip")}
    rows = []
    for arm in in_order(frame.arm):
        by_seed = frame[frame.arm == arm].groupby("seed")[list(columns)].mean()
        cells = [
            f"{by_seed[k].mean():,.{d}f} ± {by_seed[k].std():,.{d}f}"
            for k, (_, d) in columns.items()
        ]
        rows.append([arm, *cells])
    return table(["arm", *(title for title, _ in columns.values())], rows)


def first_differences(name: str, arms: Sequence[str], against: str) -> str:
    """``arm`` minus ``against`` over the pairs of scene and seed."""
    return _metrics(with_arms(pd.read_csv(ARCHIVES / "first" / f"{name}.csv")), arms, against)


def sections() -> list[tuple[str, list[Callable[[], str] | str]]]:
    """The sections of `TABLES`: a title, then sentences and tables."""
    parts = ("volumetric", "volumetric_once", "no_shrink")
    others = dict.fromkeys(
        ("absgrad", "longaxis", "pixelgs", "steepgs", "taming", "mrnf"), "volumetric"
    )
    peers = {"opensplat_fixed": "fixed", "opensplat": "adc", "fastgs": "adc"}
    both, more = ("volumetric", "volumetric_once"), ("volumetric-1", "volumetric_once-1")
    clouds = ("dim", "sfm_dense", "jittered", "sfm_all_views", "carved", "random")
    steered = ("absgrad", "longaxis", "mcmc", "volumetric", "volumetric_once")
    made = functools.partial
    by_volume = "Of all that is split or cloned, the share that is split by volume:"
    held_out = (
        "Held-out views; medians of angle and distance (scene extents) to the nearest "
        "training view:"
    )
    return [
        (
            "Plants and others",
            [
                made(claims_table, "plants"),
                "LPIPS by scene:",
                made(scenes_table, "plants", ("volumetric",)),
                "All metrics:",
                made(metrics_table, "plants", ("volumetric",)),
                by_volume,
                made(shares_table, "plants", ("volumetric",)),
                "Together with the eight scenes below, exploratory:",
                made(correlations_table, ("plants", "volume")),
                held_out,
                made(views_table, "plants"),
            ],
        ),
        (
            "Which part of the rule",
            [
                made(claims_table, "parts"),
                "LPIPS by scene:",
                made(scenes_table, "parts", parts),
                "All metrics:",
                made(metrics_table, "parts", parts),
                by_volume,
                made(shares_table, "parts", parts),
            ],
        ),
        (
            "Other rules at one count",
            [
                made(claims_table, "rules"),
                "Means over the seeds:",
                made(arms_table, "rules", others),
            ],
        ),
        (
            "A longer training",
            [
                made(claims_table, "schedule"),
                "Means over the seeds:",
                made(arms_table, "schedule", {"volumetric": "adc"}),
                by_volume,
                made(shares_table, "schedule", ("volumetric",)),
                "The same captures after 5,000 iterations (`plants`):",
                made(arms_table, "plants", {"volumetric": "adc"}, ("horns", "lewis")),
            ],
        ),
        (
            "OpenSplat beside ours",
            [
                made(claims_table, "opensplat"),
                "Means over the seeds:",
                made(arms_table, "opensplat", peers),
            ],
        ),
        (
            "Eight scenes at one count",
            [
                made(claims_table, "volume"),
                "LPIPS by scene:",
                made(scenes_table, "volume", both),
                "All metrics:",
                made(metrics_table, "volume", both),
                by_volume,
                made(shares_table, "volume", both),
                held_out,
                made(views_table, "volume"),
            ],
        ),
        (
            "More of the rule",
            [
                made(claims_table, "dimension"),
                "LPIPS by scene:",
                made(scenes_table, "dimension", more),
                "All metrics:",
                made(metrics_table, "dimension", more),
                by_volume,
                made(shares_table, "dimension", more),
                "The exponent alone, on three scenes:",
                made(metrics_table, "exponent", ["volumetric-1"], "volumetric"),
            ],
        ),
        (
            "From small to large",
            [
                "volumetric_once − adc; the courtyard's largest picture has 400 px, which it has "
                "in "
                "the row of 480 px:",
                made(sizes_table, "volumetric_once", "adc"),
                "longaxis − absgrad:",
                made(sizes_table, "longaxis", "absgrad"),
            ],
        ),
        (
            "The paper's schedule",
            [
                made(claims_table, "full"),
                made(claims_table, "full_count"),
                "Means over three seeds:",
                made(budgets_table, "full", both),
            ],
        ),
        (
            "Initial clouds",
            [
                made(claims_table, "initialisers"),
                made(clouds_table, "initialisers"),
                "All metrics:",
                made(metrics_table, "initialisers", clouds, "sfm"),
            ],
        ),
        (
            "The paper's claims, one by one",
            [
                made(claims_table, "paper"),
                "Means over four seeds:",
                made(budgets_table, "paper", ["volumetric"]),
            ],
        ),
        (
            "The long axis",
            [
                "LPIPS by scene:",
                made(scenes_table, "matched", ("longaxis",)),
                "All metrics:",
                made(metrics_table, "matched", (*both, "longaxis")),
            ],
        ),
        ("A night of ideas", [made(ideas_table, "night")]),
        (
            "The first four scenes, 160 px",
            [
                "Bonsai, 30,000 iterations, each growing up to a soft cap of 60,000:",
                made(first_table, "bonsai_growth"),
                made(first_differences, "bonsai_growth", ("adc-0.0012", *both), "adc"),
                made(first_differences, "bonsai_growth", both, "adc-0.0012"),
                "Steered to one count:",
                made(first_table, "fair_governor"),
                made(first_differences, "fair_governor", steered, "adc"),
                made(first_differences, "fair_governor", ["longaxis"], "absgrad"),
                "A hard cap:",
                made(first_table, "fair_hard"),
                made(first_differences, "fair_hard", steered, "adc"),
                made(first_differences, "fair_hard", ["longaxis"], "absgrad"),
                "Initial clouds:",
                made(first_table, "initialisers"),
                made(first_differences, "initialisers", ("dim", "sfm_dense"), "sfm"),
            ],
        ),
    ]


def all_tables() -> str:
    """The text of `TABLES`."""
    text = "# All tables of the findings\n\n"
    text += (
        "Written by `python findings/scripts/tables.py` from the archives; read [the "
        "page](README.md) first. "
    )
    text += (
        "Verdicts are gsbench's, with the interval's level in the last column. In all other "
        "tables an interval is "
    )
    text += (
        "of 95 % for one mean, over the seeds of a scene, over the scenes where there are six "
        "and more, else over "
    )
    text += (
        "the pairs of trainings. Nobody declared those, and they are not adjusted. LPIPS is "
        "SqueezeNet's.\n"
    )
    for title, parts in sections():
        text += f"\n## {title}\n\n" + "\n".join(
            part + "\n" if isinstance(part, str) else part() for part in parts
        )
    return text


def with_answers(page: str) -> str:
    """The README with its table made anew."""
    pattern = re.compile("(<!-- verdicts -->\n).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda found: found[1] + answers() + found[2], page)


def draw(file: Path) -> None:
    """Draw LPIPS along sizes and lengths for both pairs of arms: scenes as lines, their mean and
    its interval black."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    found = by_size(read_trials("scale_bridge"))
    figure, axes = plt.subplots(2, 2, figsize=(9.6, 6.4), sharey=True)
    for (arm, against), panels in zip(
        (("volumetric_once", "adc"), ("longaxis", "absgrad")), axes, strict=True
    ):
        for unit, axis in zip(("px", "iterations"), panels, strict=True):
            steps = [
                (label, differences(own, arm, against, LPIPS))
                for label, own in found
                if label.endswith(unit)
            ]
            values = [float(label.split()[0].replace(",", "")) for label, _ in steps]
            by_scene = pd.DataFrame([one.groupby("scene").mean() for _, one in steps], index=values)
            for scene in by_scene:
                axis.plot(values, by_scene[scene], linewidth=1, marker=".", label=scene)
            half = [stats.sem(one) * stats.t.ppf(0.975, len(one) - 1) for _, one in steps]
            means = by_scene.mean(axis=1)
            axis.errorbar(
                values, means, yerr=half, color="black", linewidth=2, capsize=3, label="mean"
            )
            axis.axhline(0, color="grey", linewidth=0.8)
            axis.set(xscale="log", title=f"{arm} − {against}", xlabel=unit)
            axis.set_xticks(values, [f"{value:,.0f}" for value in values])
            axis.minorticks_off()
        panels[0].set_ylabel("LPIPS")
    axes[0][0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(file, dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    TABLES.write_text(all_tables(), encoding="utf-8")
    README.write_text(with_answers(README.read_text(encoding="utf-8")), encoding="utf-8")
    draw(FINDINGS / "pictures" / "scale_bridge.png")
