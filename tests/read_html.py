"""Reading a page back: its tags are well formed, and what it shows."""

from __future__ import annotations

from html.parser import HTMLParser

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
