"""Agisoft Metashape's markers (XML): coordinates and image measurements in one file.

`chunk/reference` holds the CRS. `markers/marker` has a label and a `reference` with x, y, z (longitude before
latitude), accuracies sx, sy, sz (sxy, sxyz in older files) and `enabled`; a marker that is not is a check point.
`frames/frame/markers/marker/location` says where a camera shows it, in pixels from the upper left corner of the image;
where it is not pinned, Metashape has predicted the place, and nobody has measured it. Cameras go by their labels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.control_files.survey import Mark, Survey, SurveyedPoint, mark
from aeromatch_cli.blocks.pose_files.source import Source, number
from aeromatch_cli.errors import ConfigError

_NO = ("false", "0")


def is_markers(source: Source) -> bool:
    root = source.xml
    return root is not None and root.tag in ("document", "chunk") and root.find(".//marker") is not None


def read_markers(source: Source) -> Survey:
    """Raises ConfigError naming the marker."""
    root = source.xml_root()
    chunk = _chunk_of_markers(source, root)
    cameras = {camera.get("id"): camera.get("label", "") for camera in chunk.iter("camera") if camera.get("id")}
    markers = list(chunk.iter("marker"))
    labels = {one.get("id"): _label(one) for one in markers if one.get("id") is not None}
    points = [point for point in (_point(source, one) for one in markers) if point is not None]
    known = {point.name for point in points}
    marks = [one for one in _marks(source, markers, labels, cameras) if one.point in known]
    remarks = []
    predicted = sum(location.get("pinned", "true").lower() in _NO for location in chunk.iter("location"))
    if predicted:
        remarks.append(f"{source.path.name}: {predicted} places of markers are not pinned there: not used")
    free = [label for label in labels.values() if label not in known]
    if free:
        remarks.append(f"{source.path.name}: {len(free)} markers have no coordinates there: not used")
    crs = (chunk.findtext("reference") or root.findtext("reference") or "").strip()
    return Survey(
        tuple(points), tuple(marks), crs or None, str(source.path), remarks=tuple(remarks), measured_in=source.path
    )


def _chunk_of_markers(source: Source, root: Any) -> Any:
    """Return the chunk that has markers, the root where there is none. Raises ConfigError where several have."""
    chunks = [root] if root.tag == "chunk" else root.iter("chunk")
    chunks = [chunk for chunk in chunks if chunk.find(".//marker") is not None]
    if len(chunks) > 1:
        raise ConfigError(f"{source.path}: {len(chunks)} chunks have markers: export those of one chunk")
    return chunks[0] if chunks else root


def _label(marker: Any) -> str:
    return str(marker.get("label") or f"marker {marker.get('id')}")


def _marks(
    source: Source, markers: Sequence[Any], labels: Mapping[Any, str], cameras: Mapping[Any, str]
) -> Iterator[Mark]:
    """Find where markers were measured in images. labels, cameras: names by ids."""
    for one in markers:
        if one.get("marker_id") not in labels:
            continue
        for location in one.iter("location"):
            found = _mark(source, labels[one.get("marker_id")], cameras, location)
            if found is not None:
                yield found


def _point(source: Source, marker: Any) -> SurveyedPoint | None:
    """None for a marker without coordinates, and for the places of one in images."""
    reference = marker.find("reference")
    if reference is None or not all(reference.get(axis) for axis in "xyz"):
        return None
    label = _label(marker)
    where = f"{source.path}, marker {label!r}"
    x, y, z = (number(f"{where}, {axis}", reference.get(axis)) for axis in "xyz")
    stated = {name: number(f"{where}, {name}", reference.get(name)) for name in ("sx", "sy", "sz", "sxy", "sxyz")
              if reference.get(name)}  # fmt: skip
    sigmas_m = completed_sigmas_m(
        stated.get("sx"), stated.get("sy"), stated.get("sz"), across_m=stated.get("sxy"), overall_m=stated.get("sxyz")
    )
    return SurveyedPoint(label, where, (x, y, z), sigmas_m, reference.get("enabled", "true").lower() in _NO)


def _mark(source: Source, label: str, cameras: Mapping[Any, str], location: Any) -> Mark | None:
    """None for a place that is predicted alone."""
    if any(location.get(name, "true").lower() in _NO for name in ("pinned", "valid")):
        return None
    camera = cameras.get(location.get("camera_id"))
    if not camera:
        raise ConfigError(
            f"{source.path}, marker {label!r}: no camera has the id {location.get('camera_id')!r}: export the markers "
            "together with the cameras"
        )
    return mark(source, 0, (label, camera, location.get("x", ""), location.get("y", "")))
