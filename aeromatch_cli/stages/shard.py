"""Part i of n of a stage's items."""

from __future__ import annotations

import re
from dataclasses import dataclass

from aeromatch_cli.errors import ConfigError
from aeromatch_cli.fingerprints import stable_hash


@dataclass(frozen=True)
class Shard:
    """Part i of n of the items, chosen by a stable hash of their id: 1/2 and 2/2 are disjoint and complete."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """Read "i/n", 1 <= i <= n. Raises ConfigError."""
        found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        index, count = map(int, found.groups()) if found else (0, 0)
        if not 1 <= index <= count:
            raise ConfigError(f"--shard {text!r}: write i/n with 1 <= i <= n < 1,000,000, for example 1/4")
        return cls(index, count)

    def owns(self, item_id: str) -> bool:
        return stable_hash(item_id) % self.count == self.index - 1

    @property
    def label(self) -> str:
        return f"{self.index}-of-{self.count}"
