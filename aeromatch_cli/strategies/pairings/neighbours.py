"""Neighbours of images whose footprint is unknown: by position, by capture time, by name."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from aeromatch_cli.data import Block
from aeromatch_cli.geometry.places import place_labels
from aeromatch_cli.strategies.pairings.measure import ordered


def name_order(block: Block) -> list[str]:
    """All image ids in the order of the image names."""
    return [image.image_id for image in sorted(block.images, key=lambda image: (image.name, image.image_id))]


def time_order(block: Block) -> list[str]:
    """Ids of the images with a capture time, in the order of their times, then names."""
    timed = [image for image in block.images if image.time]
    return [image.image_id for image in sorted(timed, key=lambda image: (image.time, image.name, image.image_id))]


def position_neighbours(block: Block, wanted: Collection[str], count: int) -> set[tuple[str, str]]:
    """Pairs of each wanted image that has a position with its `count` nearest positioned images, seen from above."""
    from scipy.spatial import cKDTree

    ids = [
        image.image_id
        for image in block.images
        if image.image_id in block.poses and np.isfinite(block.poses[image.image_id].center_m).all()
    ]
    rows = [idx for idx, image_id in enumerate(ids) if image_id in wanted]
    if not rows or len(ids) < 2:
        return set()
    positions = np.array([block.poses[image_id].center_m[:2] for image_id in ids])
    # One more than asked, since every image is its own neighbour; ties at one place are broken by distance alone.
    _, nearest = cKDTree(positions).query(positions[rows], k=min(count + 1, len(ids)))
    pairs: set[tuple[str, str]] = set()
    for row, neighbours in zip(rows, np.asarray(nearest), strict=True):
        others = [int(neighbour) for neighbour in neighbours if neighbour != row][:count]
        pairs.update(ordered(ids[row], ids[other]) for other in others)
    return pairs


def order_neighbours(ids: Sequence[str], wanted: Collection[str], each_side: int) -> set[tuple[str, str]]:
    """Pairs of each wanted image with up to `each_side` images before and after it in a given order."""
    pairs: set[tuple[str, str]] = set()
    for place, image_id in enumerate(ids):
        if image_id not in wanted:
            continue
        around = range(max(place - each_side, 0), min(place + each_side + 1, len(ids)))
        pairs.update(ordered(image_id, ids[other]) for other in around if other != place)
    return pairs


def fallback_pairs(
    block: Block, unplaced: Collection[str], count: int, *, within_places: bool = False
) -> dict[tuple[str, str], str]:
    """Pairs of images without a footprint, each with the rule that found it.

    An image with a position gets its `count` nearest images by position. One without gets count / 2 on either side in
    the order of capture times, where it has one, and of names. within_places: images too far apart to show the same
    ground are no neighbours by position, and one that lies apart from all others is paired as one without position.
    """
    positioned = {i for i in unplaced if i in block.poses and np.isfinite(block.poses[i].center_m).all()}
    places = _places(block) if within_places else {}
    positioned -= {i for members in places.values() if len(members) == 1 for i in members}
    lost = set(unplaced) - positioned
    each_side = (count + 1) // 2
    reasons = dict.fromkeys(order_neighbours(name_order(block), lost, each_side), "name")
    reasons |= dict.fromkeys(order_neighbours(time_order(block), lost, each_side), "time")
    if len(places) < 2:
        return reasons | dict.fromkeys(position_neighbours(block, positioned, count), "position")
    for members in places.values():
        part = replace(block, poses={i: block.poses[i] for i in members})
        reasons |= dict.fromkeys(position_neighbours(part, positioned & members, count), "position")
    return reasons


def _places(block: Block) -> dict[int, set[str]]:
    """The images with position by their place; none of a frame without metres."""
    ids = [i for i in block.poses if np.isfinite(block.poses[i].center_m).all()]
    found: dict[int, set[str]] = {}
    if block.metric and ids:
        labels = place_labels(np.array([block.poses[i].center_m for i in ids]))
        for image_id, label in zip(ids, labels.tolist(), strict=True):
            found.setdefault(label, set()).add(image_id)
    return found
