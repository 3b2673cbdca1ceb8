"""Commands of the README, the guide and the methods run, on a small block with few keypoints."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from conftest import QUICK, UNORIENTED, Outcome, Site, invoke
from read_pages import ROOT, commands, text_of

from aeromatch_cli.cli.look_commands import LOOK
from aeromatch_cli.nets import published

pytestmark = pytest.mark.slow
SETTINGS = UNORIENTED

RUN_PAGES = [ROOT / "README.md", ROOT / "docs" / "guide.md", *sorted((ROOT / "docs" / "methods").glob("*.md"))]
# What needs files of its own: a DEM in a CRS, a configuration. tests/test_docs_links.py parses these commands.
OWN_FILES = ("--crs", "block.yaml")
STAGES_BEFORE = {"match": ("extract",), "filter": ("extract", "match")}
READ_A_WORKSPACE = ("evaluate", "show", "compare")


def given_commands() -> list[str]:
    found = dict.fromkeys(command for page in RUN_PAGES for command in commands(text_of(page), "aeromatch"))
    # tests/test_executor.py starts a scheduler and workers of its own.
    return [command for command in found if not any(mark in command for mark in (*OWN_FILES, "tcp://HOST"))]


def on_the_site(command: str, site: Site) -> list[str]:
    """Words of a command with the reader's placeholders replaced by the small block."""
    words = shlex.split(re.sub(r"\$\{?\w+\}?", "1", command), comments=True)[1:]
    places = {
        r"(IMGS|\w+/images)": str(site.images),
        r"(poses\.csv|\w+/poses_noisy\.csv)": str(site.poses),
        r"\w+/block\.json": str(site.root / "block.json"),
        r"(WORK[12]?|work[\w-]*)": str(site.work),
        r"DJI_0077(\.JPG)?": site.names()[0],
        r"DJI_0080(\.JPG)?": site.names()[1],
        r"WORK/verified/\w+\.npz": str(site.work / "verified" / f"{site.names()[0].replace('.', '_')}.npz"),
    }
    for pattern, place in places.items():
        words = [place if re.fullmatch(pattern, word) else word for word in words]
    return words


def quick(words: list[str], site: Site) -> list[str]:
    """The same with a small scene, few keypoints and one process; `check` instead of `run` where networks would run."""
    if words[0] == "synth":
        words[1] = str(site.root / "made")
        options = {"--size": "160x120", "--images": "2"}
        kept = [w for k, w in enumerate(words) if w not in options and (k == 0 or words[k - 1] not in options)]
        return [*kept, *(text for pair in options.items() for text in pair), "--jobs", "1"]
    if words[0] == "evaluate":
        return [*words[:3], str(site.root), *words[4:]]
    if words[0].startswith("-") or words[0] in ("weights", *LOOK):
        return words
    if words[0] == "run" and words[1] in ("oblique", "fusion", "polar"):
        words = ["check", *words[1:]]
        words = [w for k, w in enumerate(words) if w != "--shard" and words[k - 1] != "--shard"]
    if "--cameras" not in words:
        words += ["--cameras", str(site.root / "block.json")]
    if words[1] == "polar":
        return [*words, *QUICK[:2]]  # it has no keypoints
    return [*words, *QUICK, *(UNORIENTED if is_oriented_elsewhere(words) else ())]


def is_oriented_elsewhere(words: list[str]) -> bool:
    """Whether a command of preset baseline is about something else than orientation: plain runs have it."""
    about = ("extract", "match", "filter", "--set", "--quiet", "--json")
    return words[1] == "baseline" and "exif" not in words and any(word in about for word in words)


# What the pages repeat, in other words of the reader's, is the same command here: it runs once.
outcomes: dict[tuple[str, ...], Outcome] = {}


@pytest.mark.parametrize("command", given_commands())
def test_the_command_runs(command: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    finished = command.split()[1] in READ_A_WORKSPACE
    site: Site = request.getfixturevalue("done_site" if finished else "site")
    monkeypatch.chdir(site.root)
    monkeypatch.setenv("XDG_DATA_HOME", str(site.root / "no-data"))
    monkeypatch.setattr(published, "_PACKAGE", "no_such_package_is_installed")
    words = quick(on_the_site(command, site), site)
    known = tuple(word.replace(str(site.root), "") for word in words)
    if known not in outcomes:
        for earlier in STAGES_BEFORE.get(words[0], ()):
            assert invoke(earlier, *words[1:]).code == 0
        outcomes[known] = invoke(*words)
    outcome = outcomes[known]
    if "aliked" in command:  # weights of other people, which are not here
        assert outcome.code == 2
        assert "are no part of aeromatch" in outcome.stderr
        return
    assert outcome.code == 0, outcome.stderr
    assert outcome.stdout or "--quiet" in words


def test_commands_were_found() -> None:
    found = given_commands()
    assert len(found) > 15
    assert {"run", "synth", "evaluate", "match"} <= {shlex.split(command)[1] for command in found}
    assert Path(RUN_PAGES[0]).is_file()
