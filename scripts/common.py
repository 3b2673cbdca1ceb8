"""What the benchmark scripts share."""

from __future__ import annotations

from pathlib import Path


def write_readme(text: str, name: str) -> None:
    """Replace what stands between the README's markers of this name; SystemExit where they are missing."""
    path = Path(__file__).parent.parent / "README.md"
    start, end = f"<!-- {name}:start -->", f"<!-- {name}:end -->"
    before, found, rest = path.read_text(encoding="utf-8").partition(start)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise SystemExit(f"{path} lacks the markers {start} and {end}: add them where the table belongs")
    path.write_text(f"{before}{start}\n{text}{end}{after}", encoding="utf-8")
