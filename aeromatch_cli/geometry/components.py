"""Connected components of graphs: images that pairs tie, keypoints that matches join."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np

from aeromatch_cli.data import IntArray

N = TypeVar("N", bound=Hashable)


def component_labels(nodes: int, edges: IntArray) -> IntArray:
    """(nodes,) number of the component of each node, in the order of their first nodes. edges: (E, 2)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = np.asarray(edges, np.int32).reshape(-1, 2)
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1])


def labels_by_name(names: Sequence[N], edges: Iterable[tuple[N, N]]) -> dict[N, int]:
    """Name -> number of its component, in the order of their first names."""
    row = {name: n for n, name in enumerate(names)}
    ends = np.array([(row[one], row[other]) for one, other in edges], np.int32)
    return dict(zip(names, component_labels(len(row), ends).tolist(), strict=True))


def connected_groups(edges: Iterable[tuple[N, N]]) -> list[set[N]]:
    """Names that edges connect, the largest group first; among equal ones that of the smallest name."""
    edges = list(edges)
    names: list[Any] = sorted({name for edge in edges for name in edge})
    groups: dict[int, set[N]] = {}
    for name, label in labels_by_name(names, edges).items():
        groups.setdefault(label, set()).add(name)
    return sorted(groups.values(), key=lambda members: -len(members))
