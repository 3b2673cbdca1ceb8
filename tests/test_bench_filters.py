"""scripts/bench filters: the table, by hand."""

from benchmarks import filters as bench


def made(variant, correct, wrong, errors_px):
    return {
        "filter": variant.name,
        "threshold_px": variant.threshold_px,
        "scene": "city",
        "pair": "a b",
        "input": 200,
        "input_correct": 100,
        "verified": correct > 0,
        "correct": correct,
        "wrong": wrong,
        "ms": 1.0,
        "plane_errors_px": errors_px,
    }


def test_direct_ransac_is_shown_where_it_keeps_as_many():
    rows = []
    for variant in bench.variants(3):
        if variant.threshold_px:
            # Direct RANSAC finds 2 more correct matches per pixel, and a wrong one.
            correct = min(60 + 2 * int(variant.threshold_px), 100)
            rows.append(made(variant, correct, int(variant.threshold_px), [4.0] if variant.threshold_px == 3 else []))
        else:
            rows.append(made(variant, 90 if "clustered" in variant.name else 80, 6, [1.0]))
    lines = bench.table_of(rows, 3).splitlines()
    assert lines[0] == "1 pairs (city 1) with 200 matches, 100 of them correct (50.0 %)."
    clustered = next(line for line in lines if line.startswith("| clustered-ransac |"))
    assert clustered == "| clustered-ransac | 1 | 96 | 90 | 90.0 % | 6 | 93.8 % | 1.00 | 0.25 | 1.0 |"
    fair = next(line for line in lines if line.startswith("| homography 15 px, as many correct |"))
    assert "| 105 | 90 | 90.0 % | 15 | 85.7 % |" in fair
    assert any(line.startswith("| colour + homography + epipolar 3 px |") for line in lines)
    assert sum(line.startswith(("| magsac |", "| poselib |", "| epipolar |")) for line in lines) == 3
    assert sum(line.startswith(("| graph", "| poselib + graph |", "| epipolar + graph |")) for line in lines) == 4
