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


def peak_mb() -> float:
    """Largest resident memory of this process; getrusage would count its parent's before the exec, too."""
    status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024.0
