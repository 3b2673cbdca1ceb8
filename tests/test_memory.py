"""The memory budget: how many workers it allows, and what is said."""

from __future__ import annotations

import pytest
from conftest import UNORIENTED, Site

from aeromatch_cli.config import load
from aeromatch_cli.data import Image
from aeromatch_cli.errors import ConfigError
from aeromatch_cli.executor import Executor
from aeromatch_cli.stages.memory import budget_mb, command_mb, jobs_within, runs_network, worker_mb


def image(width: int, height: int) -> Image:
    return Image("a", "a.jpg", width, height, "1")


@pytest.mark.parametrize(
    ("text", "expected"), [("8GB", 8000.0), ("512 MB", 512.0), ("1GiB", 1073.741824), ("2.5g", 2500.0), ("", None)]
)
def test_budgets_are_read(text: str, expected: float | None) -> None:
    assert budget_mb(text) == expected


@pytest.mark.parametrize("text", ["8", "GB", "-1GB", "0GB", "8TBB"])
def test_budgets_that_are_none(text: str) -> None:
    with pytest.raises(ConfigError, match="write a number with its unit, MB or GB, such as 8GB"):
        budget_mb(text)


def test_workers_fit_the_budget() -> None:
    """12 megapixels need 350 + 144 + 700 MB: three workers and the program itself fit into 4 GB."""
    assert worker_mb(12.0) == pytest.approx(1194.0)
    jobs, remark = jobs_within(4000.0, 8, [image(4000, 3000), image(40, 30)], network=False)
    assert jobs == 3
    assert remark == "memory: 3 of 8 workers, as each needs about 1194 MB for images of 12 megapixels"
    assert jobs_within(64000.0, 8, [image(4000, 3000)], network=False) == (8, "")
    assert jobs_within(64000.0, 8, [], network=False) == (8, "")
    assert jobs_within(4000.0, 8, [image(4000, 3000)], network=True)[0] == 1
    with pytest.raises(
        ConfigError, match=r"a\.jpg has 108\.0 megapixels, .* about 2396 MB .* more --memory, or .*size"
    ):
        jobs_within(2300.0, 8, [image(12000, 9000)], network=False)
    reduced = jobs_within(2300.0, 8, [image(12000, 9000)], network=False, max_size_px=6000)
    assert reduced == (1, "memory: 1 of 8 workers, as each needs about 1374 MB for images of 27 megapixels")
    assert jobs_within(500.0, 8, [image(400, 300)], network=False)[0] == 1
    with pytest.raises(ConfigError, match=r"400 MB do not hold it: give more --memory$"):
        jobs_within(400.0, 8, [image(400, 300)], network=False)
    jobs, remark = jobs_within(2400.0, 8, [image(12000, 9000)], network=True)
    assert jobs == 1
    assert "with a network more than 2400 MB may be needed" in remark


@pytest.mark.parametrize(("preset", "words", "network"), [
    ("baseline", (), False), ("fusion", (), True), ("fusion", ("match=nearest",), False), ("oblique", (), True),
    ("auto", (), True), ("auto", ("cascade=guided",), False),
])  # fmt: skip
def test_networks_count_wherever_they_run(preset: str, words: tuple[str, ...], network: bool) -> None:
    assert runs_network(load(preset, words)) is network


def test_a_command_needs_memory_for_itself_and_its_workers() -> None:
    each = worker_mb(12.0, network=True, stored=48.0)
    assert command_mb(4, 12.0, network=True, stored=48.0) == pytest.approx(400.0 + 4.0 * each)
    # A single worker is the command's own process, whose libraries count once.
    assert command_mb(1, 12.0, network=True, stored=48.0) == pytest.approx(400.0 + each - 350.0)


@pytest.mark.slow
def test_check_counts_all_workers_and_reduced_images(site: Site) -> None:
    told = {
        words: site("check", *UNORIENTED, *words, "--jobs", "2").facts["estimate"]["memory_mb"]
        for words in ((), ("--max-size", "100"))
    }
    plain, reduced = told.values()
    assert reduced < plain
    assert plain > 400.0 + 2 * 350.0


@pytest.mark.slow
def test_an_executor_keeps_to_its_limit() -> None:
    with Executor("processes", 3) as executor:
        assert len(executor.run(abs, [-1, -2, -3], "count")) == 3
        executor.limit(1)
        executor.limit(2)  # no more than before
        assert executor.jobs == 1
        assert [outcome.value for outcome in executor.run(abs, [-1, -2], "count")] == [1, 2]


@pytest.mark.slow
def test_no_more_workers_than_tasks() -> None:
    """A thousand jobs for a few images would start as many processes."""
    with Executor("processes", 1000) as executor:
        workers = []
        for tasks in ([1, 2], [1, 2, 3], [1, 2]):
            executor.run(abs, tasks, "count")
            assert executor._pool is not None
            workers.append(set(executor._pool._processes))
        assert [len(found) for found in workers] == [2, 3, 3]
        assert workers[1] == workers[2]


@pytest.mark.slow
def test_a_run_says_how_many_workers_it_uses(site: Site) -> None:
    told = site("pairs", "--jobs", "4", "--memory", "1200MB", "--executor", "processes", "--set", "orient=none")
    assert told.code == 0
    assert "memory: 2 of 4 workers" in told.stderr
    wrong = site("pairs", "--memory", "8")
    assert wrong.code == 2
    assert "such as 8GB" in wrong.stderr
