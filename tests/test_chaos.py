"""A fault of every other kind; `scripts/chaos` injects hundreds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from chaos import injected, prepared

pytestmark = pytest.mark.slow
Calm = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Calm:
    return prepared(tmp_path_factory.mktemp("calm"))


@pytest.mark.parametrize("kind", ["run killed with its workers", "disk full", "byte flipped", "two runs at once"])
def test_a_fault_is_named_and_the_next_run_mends_it(
    calm: tuple[Path, dict[str, Any]], tmp_path: Path, kind: str
) -> None:
    assert not injected(kind, 1, *calm, tmp_path)
