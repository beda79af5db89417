"""A restatement of a refinement round: the formulas again in numpy, one Gaussian at a time.

It shares no code with gsbench. A Gaussian is a dict of raw parameters with its two Adam moments.
Normal draws are an iterator of rows, in the order in which the rules use them: all first children,
then all second ones.
"""

import math

import numpy as np

DIFFERENCES = []  # found by comparisons with the real code, for scripts/fidelity.py
PARAMETERS = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")


def rotation(q):
    w, x, y, z = q / np.sqrt((q * q).sum())
    return np.array(
        [
            [1 - 2 * y * y - 2 * z * z, 2 * x * y - 2 * w * z, 2 * x * z + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x * x - 2 * z * z, 2 * y * z - 2 * w * x],
            [2 * x * z - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x * x - 2 * y * y],
        ]
    )


def with_logit(row, value):
    """The row with another opacity, whose moments are zero."""
    zero = {f"{moment} opacity_logits": np.zeros(()) for moment in ("first", "second")}
    return row | zero | {"opacity_logits": np.array(value)}


def opacity(row):
    return float(1 / (1 + np.exp(-row["opacity_logits"])))


def logit(value):
    return float(np.log(value / (1 - value)))


def size(row):
    return np.exp(row["log_scales"]).max()


def newborn(parent, **changes):
    """A copy of ``parent`` with some other parameters, and moments of zero."""
    child = {name: np.array(parent[name], copy=True) for name in PARAMETERS} | changes
    for name in PARAMETERS:
        child["first " + name] = np.zeros_like(child[name])
        child["second " + name] = np.zeros_like(child[name])
    return child


def split_all(rows, chosen, noise, scales=None):
    """Replace each chosen row by two children: append all first ones, then all second ones.

    Their logarithmic ``scales`` are by default those of the parent divided by 1.6.
    """
    if scales is None:
        scales = {i: np.log(np.exp(rows[i]["log_scales"]) / 1.6) for i in chosen}
    children = []
    for _ in range(2):
        for i in chosen:
            s = np.exp(rows[i]["log_scales"])
            offset = rotation(rows[i]["quaternions"]) @ (s * next(noise))
            children.append(newborn(rows[i], means=rows[i]["means"] + offset, log_scales=scales[i]))
    return [row for i, row in enumerate(rows) if i not in chosen] + children


def half(row, side, place, along, across):
    """A child on one ``side`` of its parent, ``place`` scales away along the longest axis.

    The scale of that axis is multiplied by ``along``, the others by ``across``, and the opacity by
    0.6.
    """
    scales = np.exp(row["log_scales"])
    longest = int(np.argmax(scales))
    new = scales * across
    new[longest] = along * scales[longest]
    offset = side * place * scales[longest] * rotation(row["quaternions"])[:, longest]
    child = newborn(row, means=row["means"] + offset, log_scales=np.log(new))
    return with_logit(child, logit(0.6 * opacity(row)))


def halve_all(rows, chosen, child):
    """Replace each chosen row by ``child(i, side)`` on both sides: all first ones, then all second."""
    children = [child(i, side) for side in (1, -1) for i in chosen]
    return [row for i, row in enumerate(rows) if i not in chosen] + children


def adc_growth(rows, mean_gradient, extent, noise, events):
    clones = []
    chosen = []
    for i, row in enumerate(rows):
        if mean_gradient[i] < 0.0002:
            continue
        if size(row) > 0.01 * extent:
            chosen.append(i)
        else:
            clones.append(newborn(row))
    events["cloned"], events["split_gradient"] = len(clones), len(chosen)
    return split_all(rows + clones, chosen, noise)


def volume_growth(rows, threshold, noise, events, isotropic=True):
    """Unless ``isotropic``, a Gaussian whose children would be split again is not split."""
    chosen, scales, again = [], {}, 0
    for i, row in enumerate(rows):
        s = np.exp(row["log_scales"])
        if 4 / 3 * math.pi * s[0] * s[1] * s[2] > threshold:
            eigenvalues = s**2 / ((s.max() / s.min()) ** 2)  # eq. 7
            split_again = 4 / 3 * math.pi * np.sqrt(eigenvalues).prod() > threshold
            if split_again and not isotropic:
                continue
            chosen.append(i)
            scales[i] = np.log(np.sqrt(eigenvalues))
            again += split_again
    events["split_volume"], events["isotropic_resplit"] = len(chosen), int(again)
    return split_all(rows, chosen, noise, scales)


def prune(rows, step, extent, events):
    kept, events["pruned_opacity"], events["pruned_size"] = [], 0, 0
    for row in rows:
        if opacity(row) < 0.005:
            events["pruned_opacity"] += 1
        elif step > 3000 and size(row) > 0.1 * extent:
            events["pruned_size"] += 1
        else:
            kept.append(row)
    return kept
