"""OpenSfM: reconstruction.json, exif_overrides.json.

A shot's `rotation` is the angle-axis vector of cam_from_world in OpenCV's axes, `translation` t of x = R X + t; the
world is east, north, up of `reference_lla` (in the file, or in reference_lla.json beside it). Without a reference, or
with one of zeros, the block is local. Camera models: opensfm/io.py; lengths are fractions of the longer side.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from aeromatch_cli.blocks.accuracies import completed_sigmas_m
from aeromatch_cli.blocks.lenses import of_opensfm
from aeromatch_cli.blocks.pose_columns import PositionKind
from aeromatch_cli.blocks.pose_files.geodesy import from_topocentric
from aeromatch_cli.blocks.pose_files.odm import rotation_of_vector
from aeromatch_cli.blocks.pose_files.source import CameraShelf, Source, image_name, rotation_row
from aeromatch_cli.blocks.poses import PoseList, PoseRow
from aeromatch_cli.data import FloatArray
from aeromatch_cli.errors import ConfigError


def is_reconstruction(source: Source) -> bool:
    tree = source.tree
    first = tree[0] if isinstance(tree, list) and tree else tree
    return isinstance(first, dict) and isinstance(first.get("shots"), dict) and "cameras" in first


def read_reconstruction(source: Source) -> PoseList:
    """All parts of the file. Raises ConfigError naming the shot."""
    parts = source.tree if isinstance(source.tree, list) else [source.tree]
    rows: list[PoseRow] = []
    cameras = CameraShelf(source.path.name)
    kinds: set[PositionKind] = set()
    for part in parts:
        names, centers, rotations, ids = [], [], [], []
        for name, shot in part["shots"].items():
            try:
                rotation = rotation_of_vector(shot["rotation"])
                translation = np.array([float(v) for v in shot["translation"]]).reshape(3)
            except (KeyError, TypeError, ValueError, OverflowError) as error:
                raise ConfigError(
                    f"{source.path}, shot {name!r}: rotation or translation is missing ({error!r})"
                ) from error
            names.append(name)
            rotations.append(rotation)
            centers.append(-rotation.T @ translation)
            ids.append(str(shot.get("camera", "")))
        for key, entry in part["cameras"].items():
            cameras.add(str(key), of_opensfm(entry))
        reference = _reference(source, part)
        places: FloatArray = np.array(centers).reshape(-1, 3)
        local: list[FloatArray | None] = [*rotations]
        if reference is not None:
            places, local = from_topocentric(reference, places, local)
        kind: PositionKind = "grid" if reference is None else "geographic"
        kinds.add(kind)
        for name, place, attitude, camera in zip(names, places, local, ids, strict=True):
            rows.append(
                rotation_row(
                    name, 0, place, attitude, kind, true_north=reference is not None,
                    camera=cameras.key(camera),
                )
            )  # fmt: skip
    if len(kinds) > 1:
        raise ConfigError(f"{source.path}: some parts have a reference_lla and some have none: give one part alone")
    whole: PositionKind = kinds.pop() if kinds else "grid"
    remarks = list(cameras.remarks)
    if len(parts) > 1:
        remarks.append(f"{source.path.name} has {len(parts)} parts, each in a frame that only GPS ties to the others")
    where = "reference_lla" if whole == "geographic" else "local frame"
    return PoseList(tuple(rows), whole, tuple(remarks), f"OpenSfM reconstruction, {where}", None, cameras.found)


def _reference(source: Source, part: Any) -> tuple[float, float, float] | None:
    found = part.get("reference_lla")
    if not isinstance(found, dict):
        beside = source.beside("reference_lla.json")
        found = beside.tree if beside is not None and isinstance(beside.tree, dict) else None
    if found is None:
        return None
    try:
        values = tuple(float(found[key]) for key in ("latitude", "longitude", "altitude"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{source.path}: reference_lla lacks latitude, longitude or altitude ({error!r})") from error
    return (values[0], values[1], values[2]) if any(values) else None


def is_overrides(source: Source) -> bool:
    tree = source.tree
    if not isinstance(tree, dict) or not tree:
        return False
    first = next(iter(tree.values()))
    return isinstance(first, dict) and ("gps" in first or "opk" in first)


def read_overrides(source: Source) -> PoseList:
    """gps {latitude, longitude, altitude, dop} and opk {omega, phi, kappa, accuracy} of every image."""
    rows = []
    for name, facts in source.tree.items():
        gps, opk = facts.get("gps"), facts.get("opk")
        if not isinstance(gps, dict):
            raise ConfigError(f"{source.path}, image {name!r}: no gps: give latitude and longitude below a key gps")
        try:
            place = float(gps["latitude"]), float(gps["longitude"]), float(gps.get("altitude", "nan"))
            angles = tuple(float(opk[key]) for key in ("omega", "phi", "kappa")) if isinstance(opk, dict) else None
            sigma = float(gps["dop"]) if "dop" in gps else None
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ConfigError(f"{source.path}, image {name!r}: gps or opk is incomplete ({error!r})") from error
        rows.append(
            PoseRow(
                image=image_name(name), line=0, position=place, position_kind="geographic", attitude=angles,
                attitude_kind="omega_phi_kappa" if angles else "none", sigmas_m=completed_sigmas_m(overall_m=sigma),
            )
        )  # fmt: skip
    return PoseList(tuple(rows), "geographic", (), "OpenSfM exif_overrides.json")
