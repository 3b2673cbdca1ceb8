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
