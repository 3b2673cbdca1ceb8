"""weights: list, verify and add network weights that strategies find by name."""

from __future__ import annotations

from pathlib import Path

from aeromatch_cli.stages.run import Result


def manage_weights(action: str, path: str | None) -> Result:
    """List, verify or add network weights; a file that does not match its record is a failure."""
    from aeromatch_cli.nets.weights import add_weights, list_weights, shipped_weights, verify_weights, weights_folder

    if action == "add":
        entry = add_weights(Path(path or ""))
        return Result((f"added {entry.name} ({entry.architecture}), SHA-256 {entry.sha256}",), {"name": entry.name})
    if action == "verify":
        checks = verify_weights()
        lines = tuple(f"{c.name}: {c.state}" for c in checks) or (f"no weights in {weights_folder()}",)
        wrong = tuple(("weights", c.name, c.state) for c in checks if c.state != "ok")
        return Result(lines, {"weights": {c.name: c.state for c in checks}}, wrong)
    entries, shipped = list_weights(), shipped_weights()
    table = [(e, "  (ships, used without a setting)") for e in shipped] + [(e, "") for e in entries]
    listed = tuple(f"{e.name}  {e.architecture}  {e.size_bytes / 1e6:.1f} MB  {e.sha256}{note}" for e, note in table)
    nothing = () if entries else (f"no weights in {weights_folder()}",)
    facts = {"weights": [e.name for e in entries], "shipped": [e.name for e in shipped]}
    return Result((*listed, *nothing), facts)
