"""A fault of every other kind; `scripts/chaos` injects hundreds."""

from __future__ import annotations

import random

import pytest
from chaos import Calm, injected
from chaos_faults import Site, flip_byte
from conftest import invoke

from aeromatch_cli.executor import Executor
from aeromatch_cli.stages import run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def calm(tmp_path_factory: pytest.TempPathFactory) -> Calm:
    return Calm(tmp_path_factory.mktemp("calm"))


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in this process start no workers, of which each would import everything: the files are the same."""
    monkeypatch.setattr(run, "Executor", lambda _kind, _jobs, progress, _scheduler: Executor("serial", 1, progress))


def mend(site: Site) -> None:
    outcome = invoke(*site.command()[3:])
    assert outcome.code == 0, outcome.stderr


# Killed runs: tests/test_interrupted.py.
@pytest.mark.parametrize("kind", ["disk full", "input replaced", "two runs at once", "permissions revoked"])
def test_a_fault_is_named_and_the_next_run_mends_it(calm: Calm, kind: str) -> None:
    assert not injected(kind, 1, calm, "baseline", mend)


@pytest.mark.parametrize(
    "place",
    [
        "features/*.npz", "matches/*.npz", "verified/*.npz", "refined/*.npz", "export/colmap/database.db",
        "export/colmap/world.json", "pairs.csv", "reports/filter.json", "report/index.html",
    ],
)  # fmt: skip
def test_a_changed_byte_of_any_file_is_found(calm: Calm, place: str) -> None:
    def flip(site: Site, rng: random.Random) -> None:
        path = rng.choice(sorted(site.work.glob(place)))
        before = path.read_bytes()
        flip_byte(path, rng)
        assert path.read_bytes() != before

    assert not injected(flip, 1, calm, "baseline", mend)
