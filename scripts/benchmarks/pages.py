"""The results pages: which table stands on which page of docs/results."""

from __future__ import annotations

from collections.abc import Mapping

# Table -> page of docs/results. Tables stand between `<!-- table NAME: start -->` and `<!-- table NAME: end -->`.
PAGES: Mapping[str, str] = {
    "bench_methods": "methods.md",
    "bench_blocks": "methods.md",
    "bench_thinned": "methods.md",
    "bench_fusion": "fusion.md",
    "bench_fusion_per_view": "fusion.md",
    "bench_shadow": "fusion.md",
    "bench_filters": "fusion.md",
    "bench_filters_oblique": "fusion.md",
    "bench_cross": "fusion.md",
    "bench_easy": "fusion.md",
    "bench_lightglue": "lightglue.md",
    "bench_lightglue_speed": "lightglue.md",
    "bench_lightglue_speed_float32": "lightglue.md",
    "bench_polar-1840x1350": "polar.md",
    "bench_polar-7360x5400": "polar.md",
    "bench_polar_blocks": "polar.md",
    "bench_oblique": "oblique.md",
    "bench_oblique_poor": "oblique.md",
    "bench_oblique_real": "oblique.md",
    "bench_oblique_blocks": "oblique.md",
    "bench_rectification": "oblique.md",
    "bench_detector": "extraction.md",
    "bench_descriptors": "extraction.md",
    "bench_extraction": "extraction.md",
    "bench_extraction_float32": "extraction.md",
}
