"""The import contracts of pyproject.toml name every strategy: one that is forgotten could import its neighbours."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters import EXPORTERS
from aeromatch_cli.strategies.matchers import MATCHERS

PYPROJECT = Path(__file__).parent.parent / "pyproject.toml"


@pytest.mark.parametrize(
    ("contract", "table"),
    [("Matchers do not know each other", MATCHERS), ("Exporters do not know each other", EXPORTERS)],
)
def test_every_strategy_of_a_family_is_in_its_contract(contract: str, table: Mapping[str, type[Strategy]]) -> None:
    contracts = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    (modules,) = (one["modules"] for one in contracts if one["name"] == contract)
    rooms = {strategy.__module__ for strategy in table.values()}
    assert {room for room in rooms if not any(room == one or room.startswith(f"{one}.") for one in modules)} == set()
