"""The tables of `bench claims`, made of its rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.claims import features, registration, shadow
from benchmarks.claims.intervals import (
    Estimate,
    Statistic,
    change,
    column,
    difference,
    estimate,
    mean_of,
    median_of,
    of_sums,
    verdict,
)
from benchmarks.tables import Row, factor, grouped, markdown, median, number, percent, ratio, total, values

Rows = Sequence[Row]
NOT_RUN = "not run"


def mean(rows: Rows, field: str) -> float:
    """Over the rows that have a figure, NaN without any."""
    return float(np.mean(found)) if (found := values(rows, field)) else float("nan")


@dataclass(frozen=True)
class Side:
    """What one side of a claim reaches. figure: as text. against: its estimate against the paper's baseline."""

    figure: str
    against: Estimate | None = None


@dataclass(frozen=True)
class Claim:
    """claimed: the paper's figure, of `against`. larger: is better. form: how estimates are written. scope: what the
    verdict holds for, where that is less than what the paper claims."""

    name: str
    paper: str
    claimed: float
    larger: bool
    form: Callable[[float], str]
    baseline: str
    step: Side
    whole: Side
    scope: str = ""

    def line(self) -> tuple[str, ...]:
        found = [(name, verdict(side.against, self.claimed, larger=self.larger)) for name, side in self._sides()]
        same = found[0][1] == found[1][1]
        said = found[0][1] if same else ", ".join(f"{name} {what}" for name, what in found)
        cells = [
            side.figure if side.against is None else f"{side.figure}: {side.against.said(self.form)}"
            for _, side in self._sides()
        ]
        return self.name, self.paper, self.baseline, *cells, f"{said}, {self.scope}" if self.scope else said

    def _sides(self) -> tuple[tuple[str, Side], ...]:
        return ("step", self.step), ("whole", self.whole)


def _points(share: float) -> str:
    return f"{100.0 * share:+.1f} points" if np.isfinite(share) else "-"


def _percent(share: float) -> str:
    return f"{100.0 * share:+.1f} %" if np.isfinite(share) else "-"


def _plain_percent(share: float) -> str:
    return percent(share, 2)


def tables(rows: Rows) -> str:
    of = {paper: [row for row in rows if row["paper"] == paper] for paper in "ABC"}
    claims = [*_claims_a(of["A"]), *_claims_b(of["B"]), *_claims_c(of["C"])]
    heads = ("claim", "paper", "paper's baseline", "our step alone", "our whole", "verdict")
    parts = [
        ("Claims", markdown(heads, [claim.line() for claim in claims])),
        ("Paper A by light: correct matches, and those in cast shadow", _light_table(of["A"])),
        ("Paper B: accuracy at 7360 x 5400, against exact truth", _known_table(of["B"])),
        ("Paper B: seconds of the processor", _seconds_table(of["B"])),
        ("Paper C: every method, pairs of 40 degrees and more", _features_table(of["C"])),
        ("Ablation: samples of the registration", _grid_table(of["B"])),
        ("Ablation: number of clusters", _clusters_table(of["A"])),
        ("Ablation: colour", _colour_table(of["A"])),
        ("Ablation: exponent of a shadow region", _exponent_table(of["A"])),
        ("Ablation: ratio test", _ratio_table(of["C"])),
    ]
    return "\n\n".join(f"### {title}\n\n{text}" for title, text in parts if text) + "\n"


# Paper A.


def _arm(rows: Rows, arm: str, chain: str, *, dark: bool = False) -> Rows:
    """In an order that is the same for every arm."""
    own = [row for row in rows if (row["arm"], row["chain"], row["under_exposed"]) == (arm, chain, dark)]
    return sorted(own, key=lambda row: (row["scene"], row["pair"]))


def _sums(rows: Rows, part: str, whole: str) -> Statistic:
    return of_sums(column(rows, part), column(rows, whole))


def _over(rows: Rows, base: Rows, field: str) -> Estimate:
    """Ratio of sums of a field over the same pairs."""
    return estimate(of_sums(column(rows, field), column(base, field)), len(rows))


def _as_many(rows: Rows, wanted: float) -> tuple[str, Rows]:
    """The smallest threshold of direct RANSAC that keeps so many correct matches, or the largest there is."""
    swept = [(name, _arm(rows, shadow.STEP, name)) for name in map(shadow.DIRECT.format, shadow.SWEPT_PX)]
    return next((found for found in swept if total(found[1], "correct") >= wanted), swept[-1])


def _claims_a(rows: Rows) -> Iterator[Claim]:
    if not rows:
        return
    direct = shadow.DIRECT.format(shadow.THRESHOLD_PX)
    paper, step = _arm(rows, shadow.PAPER, direct), _arm(rows, shadow.STEP, direct)
    whole, clustered = _arm(rows, shadow.WHOLE, shadow.OWN), _arm(rows, shadow.STEP, shadow.CLUSTERED)

    def matches(own: Rows) -> str:
        return f"{total(own, 'correct'):.0f} correct"

    yield Claim(
        "A1 enhancement and simulated views: matches", "about 3 x", 3.0, True, factor, matches(paper),
        Side(matches(step), _over(step, paper, "correct")), Side(matches(whole), _over(whole, paper, "correct")),
    )  # fmt: skip
    for suffix, (name, base) in (
        ("", (direct, step)),
        (", as many correct matches kept", _as_many(rows, total(clustered, "correct"))),
    ):

        def error(own: Rows) -> str:
            return f"{ratio(total(own, 'error_sum_px'), total(own, 'errors')):.2f} px"

        def right(own: Rows) -> str:
            return percent(ratio(total(own, "correct"), total(own, "kept")), 1)

        def errs(own: Rows) -> Statistic:
            return _sums(own, "error_sum_px", "errors")

        def rights(own: Rows) -> Statistic:
            return _sums(own, "correct", "kept")

        yield Claim(
            f"A2 clustered against direct RANSAC: mean error against truth{suffix}", "-30 %", -0.30, False, _percent,
            f"{error(base)} ({name})",
            *(Side(error(own), estimate(change(errs(own), errs(base)), len(own))) for own in (clustered, whole)),
        )  # fmt: skip
        yield Claim(
            f"A3 the same: share of right matches{suffix}", "+24.8 %", 0.248, True, _points, f"{right(base)} ({name})",
            *(
                Side(right(own), estimate(difference(rights(own), rights(base)), len(own)))
                for own in (clustered, whole)
            ),
        )  # fmt: skip


def _lights(rows: Rows) -> Iterator[tuple[str, bool, Callable[[Row], bool]]]:
    for dark in (False, True):
        for suns, said in ((1, "one sun"), (2, "two suns")):
            if any(row["suns"] == suns and row["under_exposed"] == dark for row in rows):
                yield f"{said}{', under-exposed' if dark else ''}", dark, lambda row, suns=suns: row["suns"] == suns


def _light_table(rows: Rows) -> str:
    lines = []
    for said, dark, asked in _lights(rows):
        for arm, base in ((shadow.SHADOW, shadow.PAPER), (shadow.WHOLE, shadow.PLAIN)):
            own, other = ([r for r in _arm(rows, one, shadow.OWN, dark=dark) if asked(r)] for one in (arm, base))
            if not (own and other):
                continue
            cells = [
                f"{total(other, field):.0f} to {total(own, field):.0f}: {_over(own, other, field).said(factor)}"
                for field in ("correct", "correct_in_shadow")
            ]
            lines.append((said, len(own), f"{base} to {arm}", *cells))
    return markdown(("light", "pairs", "arms", "correct", "correct in shadow"), lines) if lines else ""


def _clusters_table(rows: Rows) -> str:
    names = {shadow.CLUSTERED: "by colour (default)", "K by count": "one for 64 matches"}
    names |= {f"K = {fixed}": str(fixed) for fixed in (1, 4, 8, 16)}
    return _chains_table(rows, names, "K")


def _colour_table(rows: Rows) -> str:
    names = ("epipolar", "colour + epipolar", "clustered-ransac + epipolar", shadow.CHAIN)
    return _chains_table(rows, {name: name for name in names}, "filter")


def _chains_table(rows: Rows, names: dict[str, str], head: str) -> str:
    lines = []
    for chain, said in names.items():
        own = _arm(rows, shadow.STEP, chain)
        if own:
            share = estimate(_sums(own, "correct", "kept"), len(own))
            error = ratio(total(own, "error_sum_px"), total(own, "errors"))
            counts = (f"{total(own, field):.0f}" for field in ("correct", "wrong"))
            lines.append((said, *counts, share.said(lambda value: percent(value, 1)), number(error, 2)))
    heads = (head, "correct", "wrong", "share right (90 % interval)", "mean error px")
    return markdown(heads, lines) if lines else ""


def _exponent_table(rows: Rows) -> str:
    lines = []
    for said, dark, asked in _lights(rows):
        plain, *others = ([r for r in _arm(rows, n, shadow.OWN, dark=dark) if asked(r)] for n in shadow.EXPONENTS)
        for name, own in zip(list(shadow.EXPONENTS)[1:], others, strict=True) if plain else ():
            cells = [_over(own, plain, field).said(factor) for field in ("correct", "correct_in_shadow")]
            lines.append((said, name, f"{total(own, 'correct'):.0f}", *cells))
    heads = ("light", "SIFT on the enhanced picture alone", "correct", "of not enhanced", "in shadow")
    return markdown(heads, lines) if lines else ""


# Paper B.


def _claims_b(rows: Rows) -> Iterator[Claim]:
    known = [row for row in rows if row["section"] == "known" and row["accepted"]]
    if known:
        sift = column(known, "sift_seconds")

        def seconds(field: str) -> Side:
            found = estimate(change(of_sums(column(known, field), sift), of_sums(sift, sift)), len(known))
            return Side(f"{mean(known, field):.2f} s", found)

        yield Claim(
            "B1 time at 7360 x 5400", "-57 %", -0.57, False, _percent, f"{np.mean(sift):.1f} s",
            seconds("exact_seconds"), seconds("tie_point_seconds"),
        )  # fmt: skip
    for section, title in (("known", "B2 known parameters"), ("unknown", "B3 unknown parameters")):
        every = [row for row in rows if row["section"] == section]
        asked = [row for row in every if row["sift_accepted"]]
        both = [row for row in asked if row["accepted"]]
        if both:
            sides = [
                Side("median", estimate(median_of(column(both, f"{name}against_share")), len(both)))
                for name in ("", "exact_")
            ]
            yield Claim(
                f"{title}: translation differs from SIFT's", "below 1 %", 0.01, False, _plain_percent,
                f"of {len(every)} pairs SIFT registers {len(asked)}, polar {len(both)} of these", *sides,
                f"on {len(both)} of {len(every)} pairs" if len(both) < len(every) else "",
            )  # fmt: skip


def _known_table(rows: Rows) -> str:
    known = [row for row in rows if row["section"] == "known"]
    lines = []
    for (kind,), own in grouped(known, "kind"):
        for name, said, accepted in (
            ("", "registration", "accepted"),
            ("exact_", "once more at full size", "accepted"),
            ("sift_", "SIFT", "sift_accepted"),
        ):
            right = [row for row in own if row[accepted]]
            figures = (
                f"{median(right, f'{name}{field}'):{form}}" if right else "-"
                for field, form in (("px", ".4f"), ("deg", ".5f"))
            )
            worst = f"{max(values(right, f'{name}px')):.4f}" if right else "-"
            lines.append((kind, said, f"{len(right)} of {len(own)}", *figures, worst))
    heads = ("ground", "method", "registered", "displacement px, median", "degrees", "largest displacement px")
    return markdown(heads, lines) if lines else ""


def _seconds_table(rows: Rows) -> str:
    lines = []
    for section in ("known", "unknown"):
        for (kind,), own in grouped([row for row in rows if row["section"] == section], "kind"):
            other = mean(own, "sift_seconds")
            mine = [mean(own, field) for field in ("seconds", "exact_seconds", "tie_point_seconds")]
            cells = [f"{seconds:.2f} ({percent(seconds / other, 1)})" for seconds in mine]
            lines.append((f"{section}, {kind}", len(own), f"{other:.2f}", *cells))
    heads = ("pairs", "number", "SIFT", "registration (of SIFT)", "with full size", "with 1,000 tie points")
    return markdown(heads, lines) if lines else ""


def _grid_table(rows: Rows) -> str:
    lines = []
    for (start,), near in grouped([row for row in rows if row["section"] == "grid"], "start"):
        own = {layout: [row for row in near if row["layout"] == layout] for layout in registration.LAYOUTS}
        base = column(own["dynamic polar"], "px")
        for layout, members in own.items():
            figures = [f"{median(members, field):{form}}" for field, form in (("px", ".4f"), ("deg", ".5f"))]
            px = column(members, "px")
            both = np.isfinite(px) & np.isfinite(base)
            against = estimate(change(median_of(px[both]), median_of(base[both])), int(both.sum()))
            found = f"{sum(row['found'] for row in members)} of {len(members)}"
            said = "-" if layout == "dynamic polar" else against.said(_percent)
            lines.append((start, layout, found, f"{median(members, 'samples'):.0f}", *figures, said))
    heads = ("start", "samples", "found", "used, median", "displacement px", "degrees", "displacement against dynamic")
    return markdown(heads, lines) if lines else ""


# Paper C.


def _claims_c(rows: Rows) -> Iterator[Claim]:
    own = {name: found for (name,), found in grouped(_section(rows, "features"), "method")}
    own = {name: sorted(found, key=lambda row: (row["scene"], row["pair"])) for name, found in own.items()}
    rivals = {name: found for name, found in own.items() if name in features.RIVALS}
    if not rivals:
        return
    step, whole = own[features.STEP], own[features.WHOLE]
    all_run = len(rivals) == len(features.RIVALS)
    scope = "two of them stand-ins" if all_run else "of those run, two of them stand-ins"

    def correct(found: Rows) -> float:
        return total(found, "correct")

    def cover(found: Rows) -> float:
        return mean(found, "coverage")

    def recall(found: Rows) -> float:
        return ratio(correct(found), total(found, "possible"))

    def best(figure: Callable[[Rows], float]) -> tuple[str, Rows]:
        return max(rivals.items(), key=lambda item: figure(item[1]))

    name, base = best(correct)
    yield Claim(
        "C1 number of right matches", "more than any", 1.0, True, factor, f"{correct(base):.0f} ({name})",
        *(Side(f"{correct(found):.0f}", _over(found, base, "correct")) for found in (step, whole)), scope,
    )  # fmt: skip
    name, base = best(cover)
    covered = mean_of(column(base, "coverage"))
    yield Claim(
        "C2 evenness: coverage", "more than any", 0.0, True, _percent, f"{cover(base):.3f} ({name})",
        *(
            Side(f"{cover(found):.3f}", estimate(change(mean_of(column(found, "coverage")), covered), len(found)))
            for found in (step, whole)
        ),
        scope,
    )  # fmt: skip
    name, base = best(recall)
    recalled = _sums(base, "correct", "possible")
    yield Claim(
        "C3 recall", "more than any", 0.0, True, _points, f"{percent(recall(base), 1)} ({name})",
        *(
            Side(
                percent(recall(found), 1),
                estimate(difference(_sums(found, "correct", "possible"), recalled), len(found)),
            )
            for found in (step, whole)
        ),
        scope,
    )  # fmt: skip


def _section(rows: Rows, section: str) -> Rows:
    return [row for row in rows if row["section"] == section]


def _features_table(rows: Rows) -> str:
    own = {name: found for (name,), found in grouped(_section(rows, "features"), "method")}
    lines = []
    for name in (*features.RIVALS, *features.OURS) if own else ():
        if name not in own:
            lines.append((name, *[NOT_RUN] * 6))
            continue
        found = own[name]
        right, possible = total(found, "correct"), total(found, "possible")
        enough = f"{sum(row['correct'] >= 30 for row in found)} of {len(found)}"
        lines.append((
            name, f"{right:.0f}", percent(ratio(right, total(found, "kept")), 1), percent(ratio(right, possible), 1),
            f"{mean(found, 'coverage'):.3f}", number(median(found, "median_error_px"), 2), enough,
        ))  # fmt: skip
    heads = ("method", "correct", "share right", "recall", "coverage", "median error px", "pairs with 30 correct")
    return markdown(heads, lines) if lines else ""


def _ratio_table(rows: Rows) -> str:
    lines = []
    for (asked, test), own in grouped(_section(rows, "ratio"), "ratio", "test"):
        counts = [total(own, field) for field in ("correct", "wrong", "filtered_correct", "filtered_wrong")]
        shares = [percent(ratio(counts[k], counts[k] + counts[k + 1]), 1) for k in (0, 2)]
        lines.append((
            test, asked, f"{counts[0]:.0f}", f"{counts[1]:.0f}", shares[0], f"{counts[2]:.0f}", f"{counts[3]:.0f}",
            shares[1],
        ))  # fmt: skip
    heads = (
        "test", "ratio", "correct", "wrong", "share right", "correct after epipolar", "wrong", "share right"
    )  # fmt: skip
    return markdown(heads, lines) if lines else ""


def legend() -> str:
    """What the arms are, for a reader who does not know their settings."""
    return "\n".join(f"- *{name}*: {words}." for name, words in {**shadow.ABOUT, **features.ABOUT}.items())
