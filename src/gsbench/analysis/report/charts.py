"""Charts as inline SVG: no script, no network, sharp on paper, and described in words for those who cannot see them."""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gsbench.words import true_minus

WIDTH, HEIGHT = 380, 250  # px at full size; text is 12 px
LEFT, RIGHT, TOP, BOTTOM = 58, 18, 26, 44
COLORS = ("#4477aa", "#cc3311", "#228833", "#aa3377", "#b8860b", "#0099a8")  # told apart also by colour-blind readers
DASHES = ("", "6 3", "2 3", "8 3 2 3", "1 2", "10 4")
TICKS = 5
THOUSANDS = 1e4  # from here on numbers are written with k or M


@dataclass(frozen=True)
class Series:
    """One line: a name and points (x, y)."""

    name: str
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class ForestRow:
    """A difference with its interval; ``low`` and ``high`` are None where no interval is known."""

    label: str
    mean: float
    low: float | None
    high: float | None


def line_chart(
    title: str,
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    log_x: bool = False,
    log_y: bool = False,
    marker: tuple[float, str] | None = None,
) -> str:
    """Lines over common axes; ``marker`` is a labelled vertical line. What a log axis cannot show is dropped."""
    shown = [
        Series(s.name, [p for p in s.points if (p[0] > 0 or not log_x) and (p[1] > 0 or not log_y)]) for s in series
    ]
    shown = [s for s in shown if s.points]
    if not shown:
        return ""
    xs = [x for s in shown for x, _ in s.points] + ([marker[0]] if marker else [])
    ys = [y for s in shown for _, y in s.points]
    x_axis = _Axis(xs, log_x, LEFT, WIDTH - RIGHT)
    y_axis = _Axis(ys, log_y, HEIGHT - BOTTOM, TOP)
    parts = [_frame(x_axis, y_axis, x_label, y_label)]
    if marker:
        x = x_axis.place(marker[0])
        parts.append(f'<line class="marker" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
        parts.append(_text(x + 4, TOP + 10, marker[1], "start"))
    for index, one in enumerate(shown):
        color, dash = COLORS[index % len(COLORS)], DASHES[index % len(DASHES)]
        path = " ".join(f"{x_axis.place(x):.1f},{y_axis.place(y):.1f}" for x, y in one.points)
        parts.append(
            f'<polyline fill="none" stroke="{color}" stroke-width="2" stroke-dasharray="{dash}" points="{path}"/>'
        )
        if len(one.points) <= TICKS:
            parts += [
                f'<circle cx="{x_axis.place(x):.1f}" cy="{y_axis.place(y):.1f}" r="3.5" fill="{color}"/>'
                for x, y in one.points
            ]
    ends = "; ".join(f"{s.name} {_ends(s.points)}" for s in shown)
    return _figure(title, f"{y_label} against {x_label}: {ends}.", parts, HEIGHT, [s.name for s in shown])


def bar_chart(title: str, labels: Sequence[str], series: Sequence[tuple[str, Sequence[float]]], y_label: str) -> str:
    """Bars grouped by label, one colour for each series; the axis starts at zero."""
    values = [value for _, row in series for value in row]
    if not values:
        return ""
    y_axis = _Axis([0.0, *values], False, HEIGHT - BOTTOM, TOP)
    slot = (WIDTH - LEFT - RIGHT) / len(labels)
    bar = 0.8 * slot / len(series)
    parts = [_y_grid(y_axis, y_label)]
    base = y_axis.place(0.0)
    for place, label in enumerate(labels):
        start = LEFT + place * slot + 0.1 * slot
        for index, (name, row) in enumerate(series):
            top = y_axis.place(row[place])
            height = abs(base - top)
            parts.append(
                f'<rect x="{start + index * bar:.1f}" y="{min(top, base):.1f}" width="{bar * 0.92:.1f}" '
                f'height="{height:.1f}" fill="{COLORS[index % len(COLORS)]}"><title>{_escape(name)}, {_escape(label)}: '
                f"{short_number(row[place])}</title></rect>"
            )
        for row_index, word in enumerate(label.split()):
            parts.append(_text(LEFT + (place + 0.5) * slot, HEIGHT - BOTTOM + 15 + 13 * row_index, word, "middle"))
    words = "; ".join(
        f"{label}: " + ", ".join(f"{name} {short_number(row[place])}" for name, row in series)
        for place, label in enumerate(labels)
    )
    return _figure(title, f"{y_label}. {words}.", parts, HEIGHT, [name for name, _ in series], dashed=False)


def forest_plot(title: str, rows: Sequence[ForestRow], x_label: str, better: int) -> str:
    """Differences with intervals, one row each, about a line at zero; ``better`` is the sign of an improvement."""
    if not rows:
        return ""
    left, step = 132, 26
    top = 12
    height = top + step * len(rows) + BOTTOM
    ends = [value for row in rows for value in (row.mean, row.low, row.high, 0.0) if value is not None]
    axis = _Axis(ends, False, left, WIDTH - RIGHT, ticks=3)
    bottom = height - BOTTOM
    parts = []
    for tick in axis.ticks:
        x = axis.place(tick)
        parts.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{top}" y2="{bottom}"/>')
        parts.append(_text(x, bottom + 15, axis.label(tick), "middle"))
    zero = axis.place(0.0)
    parts.append(f'<line class="axis" x1="{zero:.1f}" x2="{zero:.1f}" y1="{top}" y2="{bottom}"/>')
    for index, row in enumerate(rows):
        y = top + step * (index + 0.5)
        known = row.low is not None and row.high is not None
        decided = known and (row.low > 0 or row.high < 0)  # type: ignore[operator]
        color = "#555555" if not decided else "#1b7837" if row.mean * better > 0 else "#b2182b"
        if known:
            parts.append(
                f'<line x1="{axis.place(row.low):.1f}" x2="{axis.place(row.high):.1f}" y1="{y}" y2="{y}" '  # type: ignore[arg-type]
                f'stroke="{color}" stroke-width="2"/>'
            )
        parts.append(f'<circle cx="{axis.place(row.mean):.1f}" cy="{y}" r="4.5" fill="{color}"/>')
        parts.append(_text(left - 8, y + 4, row.label, "end"))
    parts.append(_text((left + WIDTH - RIGHT) / 2, height - 6, x_label, "middle"))
    words = "; ".join(
        f"{row.label} {short_number(row.mean)}"
        + (
            f", interval {short_number(row.low)} to {short_number(row.high)}"
            if row.low is not None and row.high is not None
            else ""
        )
        for row in rows
    )
    return _figure(title, f"{x_label}. {words}.", parts, height, [])


ROUND = (1, 2, 2.5, 5, 10)  # steps between ticks, of a power of ten


class _Axis:
    """Maps values to pixels, with ticks at round values."""

    def __init__(self, values: Sequence[float], log: bool, start: float, end: float, ticks: int = TICKS) -> None:
        self._log, self._start, self._end = log, start, end
        scaled = [self._scale(value) for value in values]
        low, high = min(scaled), max(scaled)
        if high - low < 1e-12:
            pad = abs(high) * 0.05 or 1.0
            low, high = low - pad, high + pad
        margin = 0.04 * (high - low)
        zero_based = not log and min(values) == 0.0
        self._low, self._high = (low if zero_based else low - margin), high + margin
        self.ticks = self._log_ticks() if log else _round_ticks(self._low, self._high, ticks)

    def label(self, tick: float) -> str:
        """The tick's value with as many digits as tell it from its neighbours."""
        step = min((b - a for a, b in itertools.pairwise(self.ticks)), default=0.0)
        if self._log or step == 0 or abs(tick) >= THOUSANDS:
            return short_number(tick)
        decimals = max(0, math.ceil(-math.log10(step) - 1e-9) + (f"{step:e}"[2] != "0"))
        return true_minus(f"{tick:.{decimals}f}")

    def place(self, value: float) -> float:
        part = (self._scale(value) - self._low) / (self._high - self._low)
        return self._start + part * (self._end - self._start)

    def _scale(self, value: float) -> float:
        return math.log10(value) if self._log else value

    def _log_ticks(self) -> list[float]:
        decades = range(math.ceil(self._low), math.floor(self._high) + 1)
        step = max(1, math.ceil(len(decades) / TICKS))
        ticks = [10.0**exponent for exponent in decades[::step]]
        return (
            ticks
            if len(ticks) > 1
            else [10.0**value for value in (self._low, (self._low + self._high) / 2, self._high)]
        )


def _round_ticks(low: float, high: float, count: int) -> list[float]:
    """About ``count`` round values between, and two at least: one alone would be no scale."""
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw))
    place = next(place for place, factor in enumerate(ROUND) if factor * power >= raw)
    for factor in (*reversed(ROUND[: place + 1]), 0.5):
        step = factor * power
        indices = range(math.ceil(low / step), math.floor(high / step) + 1)
        if len(indices) > 1:
            break
    return [index * step for index in indices]


def _frame(x_axis: _Axis, y_axis: _Axis, x_label: str, y_label: str) -> str:
    bottom = HEIGHT - BOTTOM
    parts = [_y_grid(y_axis, y_label)]
    parts += [_text(x_axis.place(tick), bottom + 16, x_axis.label(tick), "middle") for tick in x_axis.ticks]
    parts.append(_text((LEFT + WIDTH - RIGHT) / 2, HEIGHT - 8, x_label, "middle"))
    return "".join(parts)


def _y_grid(axis: _Axis, label: str) -> str:
    parts = []
    for tick in axis.ticks:
        y = axis.place(tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(_text(LEFT - 6, y + 4, axis.label(tick), "end"))
    parts.append(_text(0, 12, label, "start"))
    return "".join(parts)


def _figure(
    title: str, words: str, parts: Sequence[str], height: float, names: Sequence[str], dashed: bool = True
) -> str:
    dashes = DASHES if dashed else ("",)
    keys = "".join(
        f'<li><svg viewBox="0 0 26 8" width="26" height="8" aria-hidden="true"><line x1="0" x2="26" y1="4" y2="4" '
        f'stroke="{COLORS[i % len(COLORS)]}" stroke-width="3" stroke-dasharray="{dashes[i % len(dashes)]}"/></svg>'
        f"{_escape(name)}</li>"
        for i, name in enumerate(names)
    )
    legend = f'<ul class="legend">{keys}</ul>' if len(names) > 1 else ""
    return (
        f'<figure class="chart"><figcaption>{_escape(title)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{_escape(f"{title}. {words}")}">'
        f"{''.join(parts)}</svg>{legend}</figure>"
    )


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{_escape(text)}</text>'


def _ends(points: Sequence[tuple[float, float]]) -> str:
    """The first and the last point in words."""
    (x0, y0), (x1, y1) = points[0], points[-1]
    return f"from {short_number(y0)} at {short_number(x0)} to {short_number(y1)} at {short_number(x1)}"


def short_number(value: float) -> str:
    """A number as short as a tick label needs it, such as 26k or −0.02."""
    size = abs(value)
    for limit, suffix in ((1e6, "M"), (THOUSANDS, "k")):
        if size >= limit:
            return true_minus(f"{value / {'M': 1e6, 'k': 1e3}[suffix]:.3g}{suffix}")
    text = f"{value:.0e}" if 0 < size < 1e-4 else f"{value:.3g}" if size < 1000 else f"{value:.0f}"
    return true_minus(text)


_escape: Callable[[str], str] = html.escape
