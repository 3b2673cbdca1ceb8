"""Reading a page back: its tags are well formed, and what it shows."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from xml.etree import ElementTree

VOID = {"meta", "input", "link", "br", "hr", "img"}


class Structure(HTMLParser):
    """Checks that every tag is closed in order; keeps visible text, attributes and tags."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.stack: list[str] = []
        self.faults: list[str] = []
        self.text: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, key, value or "") for key, value in attrs]
        if tag not in VOID:
            self.stack.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.attributes += [(tag, key, value or "") for key, value in attrs]

    def handle_endtag(self, tag):
        if not self.stack or self.stack.pop() != tag:
            self.faults.append(f"</{tag}> at {self.getpos()}")

    def handle_data(self, data):
        if self.stack and self.stack[-1] not in ("script", "style"):
            self.text.append(data)

    @classmethod
    def of(cls, page: str) -> Structure:
        parser = cls()
        parser.feed(page)
        parser.close()
        assert not parser.faults
        assert not parser.stack
        return parser

    def words(self) -> str:
        return " ".join(" ".join(self.text).split())


def shapes(svg: str, css: str) -> list[tuple[str, list[float]]]:
    """(tooltip, coordinates) of every path, and of every use of a marker, in the groups of one CSS class."""
    found = []
    for group in ElementTree.fromstring(svg).iter("g"):
        if group.get("class") == css:
            markers = {path for defs in group.iter("defs") for path in defs.iter("path")}
            for shape in (s for s in group.iter() if s.tag in ("path", "use") and s not in markers):
                text = shape.get("d") or f"{shape.attrib['x']} {shape.attrib['y']}"
                numbers = [float(number) for number in re.findall(r"-?\d+\.?\d*", text)]
                found.append((shape.findtext("title") or "", numbers))
    return found
