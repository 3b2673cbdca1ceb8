"""Damaged input ends in the project's own errors. `scripts/fuzz` tries many more cases."""

from __future__ import annotations

from pathlib import Path

import pytest
from fuzzing import faults, readers

READERS = readers()
# Seeds that once found a fault are tried as long as the code is: the first ones are those of every run.
CASES = 240


@pytest.mark.parametrize("name", sorted(READERS))
def test_damaged_files_end_in_our_own_errors(tmp_path: Path, name: str) -> None:
    found = list(faults(READERS[name], CASES, 0, tmp_path))
    assert not found, "\n".join(f"{file}: {what}" for file, _, what in found[:3])
