"""Which attitudes contradict the pictures, from exact relative rotations."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from aeromatch_cli.data import FloatArray, Pose
from aeromatch_cli.geometry.rotations import rotation_z
from aeromatch_cli.orientation.attitudes import LARGEST_DIFFERENCE_DEG, LEAST_MATCHES, contradicting_images

RelativeRotation = tuple[str, str, FloatArray, int]


def attitudes(names: Iterable[str], seed: int = 0) -> dict[str, FloatArray]:
    """True world rotations: near nadir, any heading."""
    rng = np.random.default_rng(seed)
    return {
        name: Rotation.from_euler("zyx", [rng.uniform(-180, 180), *rng.uniform(-20, 20, 2)], degrees=True).as_matrix()
        @ np.diag([1.0, -1.0, -1.0])
        for name in names
    }


def poses(given: dict[str, FloatArray | None]) -> dict[str, Pose]:
    return {name: Pose(np.zeros(3), rotation, 1.0, 1.0) for name, rotation in given.items()}


def measured(
    truth: dict[str, FloatArray], pairs: Iterable[tuple[str, str]], matches: int = 100
) -> list[RelativeRotation]:
    return [(a, b, truth[b] @ truth[a].T, matches) for a, b in pairs]


def strip(names: Sequence[str], reach: int = 3) -> list[tuple[str, str]]:
    """Each image with its next ones, as along a flight line."""
    return [(a, b) for a, b in itertools.combinations(names, 2) if names.index(b) - names.index(a) <= reach]


def turned(
    truth: dict[str, FloatArray], wrong: Iterable[str], angle_deg: float = 180.0
) -> dict[str, FloatArray | None]:
    """The given attitudes: those of `wrong` are turned about the optical axis, like pictures turned after capture."""
    return {name: rotation_z(angle_deg) @ r if name in set(wrong) else r for name, r in truth.items()}


NAMES = [f"i{number:02}" for number in range(18)]


@pytest.mark.parametrize(
    "wrong", [[], ["i00"], ["i17"], ["i07"], ["i02", "i09", "i15"], [f"i{n:02}" for n in range(6, 12)], NAMES[:8]]
)
def test_turned_images_are_found_also_a_connected_run_of_them(wrong: list[str]) -> None:
    truth = attitudes(NAMES)
    found = contradicting_images(poses(turned(truth, wrong)), measured(truth, strip(NAMES)))
    assert list(found) == wrong
    assert list(found.values()) == pytest.approx([180.0] * len(wrong), abs=0.1)


@pytest.mark.parametrize(("angle_deg", "count"), [(30.0, 0), (44.0, 0), (46.0, 1), (90.0, 1)])
def test_only_differences_beyond_the_limit_count(angle_deg: float, count: int) -> None:
    truth = attitudes(NAMES)
    found = contradicting_images(poses(turned(truth, ["i05"], angle_deg)), measured(truth, strip(NAMES)))
    assert len(found) == count
    assert LARGEST_DIFFERENCE_DEG == 45.0
    if count:
        assert found["i05"] == pytest.approx(angle_deg, abs=0.1)


@pytest.mark.parametrize("seed", range(5))
def test_noise_of_some_degrees_in_poses_and_matches_passes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = attitudes(NAMES, seed)
    noisy: dict[str, FloatArray | None] = {
        name: Rotation.from_rotvec(rng.normal(0, np.radians(3), 3)).as_matrix() @ rotation
        for name, rotation in turned(truth, ["i04", "i05"]).items()
        if rotation is not None
    }
    pairs = [
        (a, b, Rotation.from_rotvec(rng.normal(0, np.radians(0.5), 3)).as_matrix() @ rotation, matches)
        for a, b, rotation, matches in measured(truth, strip(NAMES))
    ]
    assert list(contradicting_images(poses(noisy), pairs)) == ["i04", "i05"]


def test_a_common_turn_of_the_whole_world_contradicts_nothing() -> None:
    truth = attitudes(NAMES)
    world = Rotation.from_euler("xyz", [10.0, 20.0, 130.0], degrees=True).as_matrix()
    given: dict[str, FloatArray | None] = {name: rotation @ world for name, rotation in truth.items()}
    assert contradicting_images(poses(given), measured(truth, strip(NAMES))) == {}


@pytest.mark.parametrize("names", [["a", "b"], ["a", "b", "c", "d"]])
def test_without_majority_nobody_is_accused(names: list[str]) -> None:
    truth = attitudes(names)
    assert contradicting_images(poses(turned(truth, names[: len(names) // 2])), measured(truth, strip(names))) == {}


def test_three_images_outvote_one() -> None:
    truth = attitudes("abc")
    assert list(contradicting_images(poses(turned(truth, "b")), measured(truth, strip("abc")))) == ["b"]


def test_components_are_judged_on_their_own() -> None:
    """Two blocks without a common pair: the second lies in a world turned by 180 degrees and has one turned image."""
    first, second = NAMES[:6], NAMES[6:12]
    truth = attitudes(NAMES[:12])
    half = rotation_z(180.0)
    given = turned(truth, ["i03", "i08"])
    given |= {name: given[name] @ half for name in second if given[name] is not None}  # type: ignore[operator]
    found = contradicting_images(poses(given), measured(truth, strip(first) + strip(second)))
    assert list(found) == ["i03", "i08"]


def test_images_without_attitude_are_ignored() -> None:
    truth = attitudes(NAMES[:8])
    given = turned(truth, ["i02"]) | {"i04": None}
    known = poses(given)
    del known["i05"]
    assert list(contradicting_images(known, measured(truth, strip(NAMES[:8])))) == ["i02"]
    assert contradicting_images({}, measured(truth, strip(NAMES[:8]))) == {}
    assert contradicting_images(known, []) == {}


def test_strong_pairs_decide_against_a_weak_wrong_one() -> None:
    """A pair of 16 matches with a wrong rotation is not used while stronger pairs connect its images."""
    truth = attitudes(NAMES[:6])
    false = ("i00", "i05", rotation_z(120.0) @ truth["i05"] @ truth["i00"].T, 16)
    found = contradicting_images(poses(dict(truth)), [false, *measured(truth, strip(NAMES[:6]))])
    assert found == {}


def test_order_of_pairs_does_not_matter() -> None:
    truth = attitudes(NAMES)
    pairs = measured(truth, strip(NAMES))
    given = poses(turned(truth, ["i01", "i02"]))
    shuffled = [pairs[index] for index in np.random.default_rng(3).permutation(len(pairs))]
    assert contradicting_images(given, pairs) == contradicting_images(given, shuffled)


def test_few_matches_accuse_nobody() -> None:
    truth = attitudes(NAMES)
    given = poses(turned(truth, ["i07"]))
    assert contradicting_images(given, measured(truth, strip(NAMES), matches=LEAST_MATCHES - 1)) == {}
    assert list(contradicting_images(given, measured(truth, strip(NAMES), matches=LEAST_MATCHES))) == ["i07"]
