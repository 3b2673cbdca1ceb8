"""The results pages of docs/results: benchmarks write their tables there, each with a stamp of what it rests on.

    <!-- table NAME: start -->
    <!-- stamp {"command": ..., "commit": ..., "date": ..., "machine": ..., "trained_on": [...], "versions": {...}} -->

    Older than the code; changed since: FAMILY.STRATEGY, ....

        scripts/bench ...

    Commit ..., DATE; MACHINE; networks trained on ....

    | ... |
    <!-- table NAME: end -->

`versions` holds every number that the table depends on: FAMILY.STRATEGY, "pipeline", "filter.chain" and
"weights.NETWORK" (SHA-256, 12 digits); null is unknown. The first line of a table says which of them have changed, and
is left out where none has. `scripts/bench pages` brings these lines up to date.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from aeromatch_cli.files import write_text
from benchmarks.stamps import REPOSITORY, Stamp, Versions, changed, present_versions, said

FOLDER = REPOSITORY / "docs" / "results"
# Table -> page.
PAGES: Mapping[str, str] = {
    "bench_methods": "methods.md",
    "bench_claims": "claims.md",
    "bench_presets": "auto.md",
    "bench_presets_second": "auto.md",
    "bench_presets_nothing": "auto.md",
    "bench_presets_positions": "auto.md",
    "bench_evidence": "auto.md",
    "bench_probability": "auto.md",
    "bench_auto_real": "auto.md",
    "bench_auto_unknown": "auto.md",
    "bench_growth_blocks": "large.md",
    "bench_device": "large.md",
    "bench_memory": "large.md",
    "bench_speed": "large.md",
    "bench_blocks": "methods.md",
    "bench_thinned": "methods.md",
    "bench_fusion": "fusion.md",
    "bench_fusion_per_view": "fusion.md",
    "bench_shadow": "fusion.md",
    "bench_filters": "fusion.md",
    "bench_filters_oblique": "fusion.md",
    "bench_cross": "fusion.md",
    "bench_easy": "fusion.md",
    "bench_lightglue": "lightglue.md",
    "bench_lightglue_speed": "lightglue.md",
    "bench_lightglue_speed_float32": "lightglue.md",
    "bench_calibration": "calibration.md",
    "bench_calibration_peers": "calibration.md",
    "bench_quality": "quality.md",
    "bench_orient": "orient.md",
    "bench_orient_thinned": "orient.md",
    "bench_orient_rendered": "orient.md",
    "bench_orient_oblique": "orient.md",
    "bench_orient_noisy": "orient.md",
    "bench_orient_many": "orient.md",
    "bench_growth": "orient.md",
    "bench_chains": "orient.md",
    "bench_similar": "orient.md",
    "bench_polar-1840x1350": "polar.md",
    "bench_polar-7360x5400": "polar.md",
    "bench_polar_blocks": "polar.md",
    "bench_oblique": "oblique.md",
    "bench_oblique_poor": "oblique.md",
    "bench_oblique_real": "oblique.md",
    "bench_oblique_blocks": "oblique.md",
    "bench_rectification": "oblique.md",
    "bench_detector": "extraction.md",
    "bench_descriptors": "extraction.md",
}
_TABLE = re.compile(r"<!-- table (\S+): start -->\n(.*?)<!-- table \1: end -->", re.DOTALL)
_STAMP = re.compile(r"<!-- stamp (\{.*\}) -->\n")
_HEAD = re.compile(_STAMP.pattern + r"\n(?:Older than the code.*\n\n)?    \S.*\n\nCommit .*\n")


def write_table(page: Path, name: str, text: str, stamp: Stamp) -> None:
    """Replace what stands between the page's markers of this name, and bring the page up to date.

    Raises SystemExit where the markers are missing.
    """
    old = page.read_text(encoding="utf-8") if page.is_file() else ""
    if not any(match[1] == name for match in _TABLE.finditer(old)):
        start, end = f"<!-- table {name}: start -->", f"<!-- table {name}: end -->"
        raise SystemExit(f"{page} lacks the lines {start} and {end}: add them where the table belongs")
    body = f"<!-- table {name}: start -->\n{head(stamp, {})}\n{text.strip()}\n<!-- table {name}: end -->"
    new = _TABLE.sub(lambda match: body if match[1] == name else match[0], old)
    write_text(page, refreshed(new))


def head(stamp: Stamp, present: Versions) -> str:
    """The lines of a table above its text."""
    lines = [f"<!-- stamp {json.dumps(stamp, ensure_ascii=False)} -->", f"    {stamp['command']}", said(stamp)]
    if older := list(changed(stamp, present)):
        what = "what it rests on is not known" if stamp["versions"] is None else f"changed since: {', '.join(older)}"
        lines.insert(1, f"Older than the code; {what}.")
    return "\n\n".join(lines) + "\n"


def stamps(page_text: str) -> Iterator[tuple[str, Stamp]]:
    """Name and stamp of every table of a page, but for those not made yet. Raises ValueError where one has none."""
    for match in _TABLE.finditer(page_text):
        if not match[2].strip():
            continue
        found = _STAMP.search(match[2])
        if found is None:
            raise ValueError(f"table {match[1]} has no stamp")
        yield match[1], json.loads(found[1])


def table_names(page_text: str) -> list[str]:
    """Of all tables of a page, made or not."""
    return [match[1] for match in _TABLE.finditer(page_text)]


def outdated_tables(page_text: str, present: Versions | None = None) -> list[str]:
    """Tables of a page that depend on a version which is another one now."""
    now = present_versions() if present is None else present
    return [name for name, stamp in stamps(page_text) if any(changed(stamp, now))]


def refreshed(page_text: str, present: Versions | None = None) -> str:
    """The page with the lines above every table's text as its stamps say."""
    now = present_versions() if present is None else present
    return _HEAD.sub(lambda match: head(json.loads(match[1]), now), page_text)


def main(arguments: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="scripts/bench pages", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(arguments)
    present = present_versions()
    for path in sorted(FOLDER.glob("*.md")):
        text = path.read_text(encoding="utf-8")
        write_text(path, refreshed(text, present))
        for name, stamp in stamps(text):
            print(f"{path.name}: {name}: {', '.join(changed(stamp, present)) or 'up to date'}")
