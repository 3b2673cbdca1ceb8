"""weights: list, verify and add network weights that strategies find by name."""

from __future__ import annotations

from pathlib import Path

from aeromatch_cli.stages.command_result import Result


def manage_weights(action: str, path: str | None) -> Result:
    """List, verify or add network weights; a file that does not match its record is a failure."""
    from aeromatch_cli.nets import files, folder, published

    if action == "add":
        entry = folder.add_weights(Path(path or ""))
        return Result((f"added {entry.name} ({entry.architecture}), SHA-256 {entry.sha256}",), {"name": entry.name})
    nothing = f"no weights in {folder.weights_folder()}"
    if action == "verify":
        ships, checks = files.verify_shipped(), folder.verify_weights()
        lines = tuple(f"{c.name}: {c.state}  (ships)" for c in ships)
        lines += tuple(f"{c.name}: {c.state}" for c in checks) or (nothing,)
        wrong = tuple(("weights", c.name, c.state) for c in (*ships, *checks) if c.state != "ok")
        facts = {"weights": {c.name: c.state for c in checks}, "shipped": {c.name: c.state for c in ships}}
        return Result(lines, facts, wrong)
    entries, shipped = folder.list_weights(), files.shipped_weights()
    others = published.in_packages()
    table = [(e, "  (ships, used without a setting)") for e in shipped]
    table += [(e, f"  ({terms})" if (terms := published.terms_of(e.sha256)) else "") for e in entries]
    table += [(e, f"  ({published.terms_of(e.sha256) or 'not as published'}; in an installed package)") for e in others]
    lacking = published.not_found()
    absent = [f"{p.file}  {p.architecture}  not found  ({p.source}; {p.licence})" for p in lacking]
    absent += [f"published weights that were not found: {published.HOW_TO_GET}"] if lacking else []
    listed = tuple(f"{e.name}  {e.architecture}  {e.size_bytes / 1e3:,.0f} kB  {e.sha256}{note}" for e, note in table)
    return Result(
        (*listed, *(() if entries else (nothing,)), *absent),
        {
            "weights": [e.name for e in entries],
            "shipped": [e.name for e in shipped],
            "packages": [e.name for e in others],
            "not_found": [p.file for p in lacking],
        },
    )
