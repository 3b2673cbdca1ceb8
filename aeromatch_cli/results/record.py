"""Records: typed values that become JSON and come back from it unchanged."""

from __future__ import annotations

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, ValidationError


class Record(BaseModel):
    """A value of named, typed fields. Fields that JSON has and the type does not are an error."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)

    def as_json(self) -> dict[str, Any]:
        """The fields as `json.dumps` takes them."""
        return self.model_dump(mode="json")

    @classmethod
    def of_json(cls, value: Any) -> Self | None:
        """The record that `as_json` gave, or None where the value was written by another version of the type."""
        try:
            return cls.model_validate(value)
        except ValidationError:
            return None


class StageRecord(Record):
    """What a stage has left: the contents of reports/<stage>.json. Ids name images.

    items = done (made by the run that wrote it) + skipped (up to date already) + failed; items are images, pairs or
    exporters. result: of the stage's own type. failures: item and reason. files: SHA-256 of the files that a stage of
    the whole block has written, by their names in the workspace.
    """

    stage: str
    seconds: float = 0.0
    items: int = 0
    done: int = 0
    skipped: int = 0
    failed: int = 0
    fingerprint: str = ""
    result: dict[str, Any] | None = None
    failures: list[tuple[str, str]] = []
    files: dict[str, str] = {}
