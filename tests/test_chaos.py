"""A fault of every other kind; `scripts/chaos` injects hundreds."""

from __future__ import annotations

import pytest
from chaos import Calm, injected

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Calm:
    return Calm(tmp_path_factory.mktemp("calm"))


@pytest.mark.parametrize(
    "kind", ["run killed with its workers", "disk full", "input replaced", "two runs at once", "permissions revoked"]
)
def test_a_fault_is_named_and_the_next_run_mends_it(calm: Calm, kind: str) -> None:
    assert not injected(kind, 1, calm, "baseline")


@pytest.mark.parametrize("seed", range(6))
def test_a_changed_byte_of_any_file_is_found(calm: Calm, seed: int) -> None:
    assert not injected("byte flipped", seed, calm, "baseline")
