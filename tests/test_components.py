"""Connected components by name and by number."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from aeromatch_cli.geometry.components import component_labels, connected_groups, labels_by_name


def test_groups_come_largest_first_and_equal_ones_by_their_names() -> None:
    edges = [("d", "e"), ("b", "a"), ("x", "y"), ("y", "z"), ("c", "c")]
    assert connected_groups(edges) == [{"x", "y", "z"}, {"a", "b"}, {"d", "e"}, {"c"}]
    assert connected_groups([]) == []
    assert labels_by_name(["q", "a", "b"], [("b", "a")]) == {"q": 0, "a": 1, "b": 1}


@given(st.integers(1, 12).flatmap(lambda n: st.tuples(st.just(n), st.lists(st.tuples(*[st.integers(0, n - 1)] * 2)))))
def test_nodes_have_one_label_where_a_path_leads_from_one_to_the_other(
    graph: tuple[int, list[tuple[int, int]]],
) -> None:
    nodes, edges = graph
    reach = np.eye(nodes, dtype=bool)
    for one, other in edges:
        reach[one, other] = reach[other, one] = True
    for _ in range(nodes):
        reach = reach @ reach
    labels = component_labels(nodes, np.array(edges, np.int32).reshape(-1, 2))
    assert (np.equal.outer(labels, labels) == reach).all()
    assert [*dict.fromkeys(labels.tolist())] == list(range(labels.max() + 1))
