"""The documentation as tests read it: pages, links, anchors, and the commands in their text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_FENCE = re.compile(r"^\s*(```|~~~)")
# A command begins a line of code (behind a prompt, a schedule of cron or an operator) and ends with the line or an
# operator of the shell.
_COMMAND = r"(?:^|[\s;&|(])(?:\$ )?({name} .*?)(?=\s*(?:\|\||&&|[|;<>]|\s#\s|$))"


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(text: str) -> Iterator[list[str]]:
    """Code blocks, indented or fenced, as lines without their indentation."""
    found: list[str] = []
    fenced = False
    for line in [*text.splitlines(), ""]:
        if _FENCE.match(line):
            if fenced:
                yield found
                found = []
            fenced = not fenced
        elif fenced or re.match(r"^( {4,}|\t)\S", line):
            found.append(line.strip() if not fenced else line)
        elif found and line.strip():
            yield found
            found = []
    if found:
        yield found


def code_lines(text: str) -> list[str]:
    """Lines of code blocks, with those that a backslash continues joined."""
    joined = "\n".join(line for block in blocks(text) for line in block)
    return re.sub(r"\\\n\s*", " ", joined).splitlines()


def inline_code(text: str) -> list[str]:
    """What stands in backticks outside of code blocks, line breaks as blanks."""
    prose = re.sub(r"(?m)^( {4,}|\t).*$", "", text)
    return [" ".join(part.split()) for part in re.findall(r"`([^`]+)`", prose)]


def commands(text: str, name: str) -> list[str]:
    """Commands of `name` in code blocks."""
    pattern = re.compile(_COMMAND.format(name=re.escape(name)))
    return [found.strip() for line in code_lines(text) for found in pattern.findall(line)]


def links(text: str) -> list[str]:
    """Targets of links and pictures outside of code blocks."""
    prose = re.sub(r"(?m)^( {4,}|\t).*$", "", text)
    return re.findall(r"\]\(([^)\s]+)\)", re.sub(r"`[^`]*`", "", prose))


def anchors(text: str) -> set[str]:
    """What GitHub makes of the headings."""
    titles = [
        re.sub(r"[`*\\]", "", line.lstrip("#").strip()) for line in text.splitlines() if re.match(r"#{1,6} ", line)
    ]
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
