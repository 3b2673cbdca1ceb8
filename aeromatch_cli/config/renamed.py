"""Settings and strategies that had another name before, or are gone: an old name is an error that says what to take."""

from __future__ import annotations

from collections.abc import Mapping

# Section -> strategy ("" = every one of the section) -> old key -> new key.
SETTINGS: Mapping[str, Mapping[str, Mapping[str, str]]] = {
    "enhance": {
        "": {"beside": "keep_source", "one_sun_minutes": "same_illumination_minutes"},
    },
    "simulate": {
        "": {"source": "keep_source"},
        "neighbours": {"min_tilt": "min_stretch"},
    },
    "match": {
        "": {"ample": "guide_below_matches"},
        "lightglue": {"enough": "network_below_matches", "overlap": "only_overlap"},
        "polar": {
            "smallest_scale": "min_scale",
            "largest_scale": "max_scale",
            "window": "window_px",
            "least_correlation": "min_correlation",
            "largest_sigma_px": "max_sigma_px",
        },
    },
    "filter": {
        "": {"false_alarms": "max_false_alarms"},
        "colour": {"limit": "max_distance", "medians": "max_distance_medians"},
        "graph": {"least": "min_support", "share": "min_support_share"},
        "clustered-ransac": {"support": "min_support"},
        "epipolar": {"narrowest_px": "min_band_px"},
    },
    "consistency": {"block": {"raised_up_to": "most_given_up"}},
}
# Section -> old name of a strategy -> new name.
STRATEGIES: Mapping[str, Mapping[str, str]] = {"extract": {"lattice": "grid"}}
# Section -> strategies that are gone: benchmarks alone still know them.
DROPPED: Mapping[str, tuple[str, ...]] = {
    "enhance": ("clahe", "wallis"),
    "simulate": ("tilts",),
    "filter": ("homography", "magsac"),
}


def new_key(section: str, key: str, valid: frozenset[str]) -> str | None:
    """The present name of an unknown key of a section, None where it never was one. valid: keys of its place."""
    for renamed in SETTINGS.get(section, {}).values():
        if renamed.get(key) in valid:
            return renamed[key]
    return None
