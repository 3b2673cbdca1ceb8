"""Old names of settings are errors that say the new name, and every new name exists."""

from __future__ import annotations

import pytest

from aeromatch_cli.config import FAMILIES, load
from aeromatch_cli.config.renamed import DROPPED, SETTINGS, STRATEGIES
from aeromatch_cli.errors import ConfigError

CHAINED = ("filter", "export")


def cases() -> list[tuple[str, str, str, str]]:
    """Section, strategy, old key, new key: for "" the first strategy that has the new key."""
    found = []
    for section, strategies in SETTINGS.items():
        for strategy, keys in strategies.items():
            for old, new in keys.items():
                owners = [name for name, one in FAMILIES[section].items() if new in one.model_fields]
                assert owners, f"{section}: no strategy has {new}"
                found.append((section, strategy or owners[0], old, new))
    return found


@pytest.mark.parametrize(("section", "strategy", "old", "new"), cases())
def test_an_old_setting_names_the_new_one(section: str, strategy: str, old: str, new: str) -> None:
    place = f"{section}.{strategy}" if section in CHAINED else section
    extractor = "grid" if strategy == "polar" else "sift"
    chain = f"{strategy}+poselib" if strategy in ("graph", "colour") else strategy
    chosen = [f"extract={extractor}", f"{section}={chain if section in CHAINED else strategy}"]
    if strategy == "colour":
        chosen.append("extract.colours=true")
    load("baseline", chosen)  # the choice itself is valid
    with pytest.raises(ConfigError, match=rf"{place}\.{old}: this setting is now named {new}; write {place}\.{new}"):
        load("baseline", [*chosen, f"{place}.{old}=1"])


def test_an_old_strategy_names_the_new_one() -> None:
    assert STRATEGIES == {"extract": {"lattice": "grid"}}
    with pytest.raises(ConfigError, match="extract: the strategy 'lattice' is now named 'grid'"):
        load("polar", ["extract=lattice"])


@pytest.mark.parametrize(("section", "name"), [(section, name) for section in DROPPED for name in DROPPED[section]])
def test_a_strategy_that_is_gone_names_those_that_there_are(section: str, name: str) -> None:
    with pytest.raises(ConfigError, match=f"{section}: there is no strategy '{name}' any more; take '"):
        load("baseline", [f"{section}={name}"])
