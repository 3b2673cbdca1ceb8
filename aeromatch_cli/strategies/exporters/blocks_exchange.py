"""BlocksExchange XML with tie points, for Metashape, ContextCapture and iTwin Capture.

Pixels count from the middle of the first pixel; rotations are cam_from_world with x right and y down; centres are in
the block's CRS. Distortion is Brown's, with P1 and P2 exchanged against OpenCV's p1 and p2, and Skew is b2 in pixels: a
fisheye lens is written as the nearest such camera.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Literal
from xml.sax.saxutils import escape

import numpy as np

from aeromatch_cli.data import Camera, FloatArray, Image
from aeromatch_cli.geometry.cameras import BROWN, MODELS, parameters
from aeromatch_cli.geometry.lenses import nearest_of
from aeromatch_cli.strategies import Strategy
from aeromatch_cli.strategies.exporters.contents import ExportContents, ExportSummary, whole_folder
from aeromatch_cli.strategies.exporters.solution import (
    Matched,
    Solution,
    held,
    keypoints_of,
    matched,
    summary_of,
    write,
)

_LOCAL = "local"


class BlocksExchange(Strategy):
    """Writes blocks.xml: cameras, poses, and the points of the adjusted block with their measurements."""

    version: ClassVar[int] = 5
    name: Literal["blocks-exchange"] = "blocks-exchange"

    def __call__(self, contents: ExportContents, folder: Path) -> ExportSummary:
        """Replace `folder`. WorkspaceError where it cannot be written."""
        solution = Solution.of(contents)
        with whole_folder(folder) as partial:
            found = matched(contents, adjusted_tracks=True)
            keypoints = keypoints_of(contents)
            origin_m, crs = np.array(contents.block.origin_m), contents.block.crs
            of_camera: dict[str, list[tuple[int, Image]]] = defaultdict(list)
            for place, image in enumerate(solution.images):
                of_camera[image.camera_id].append((place, image))
            cameras, remarks = held(solution, "BlocksExchange", lambda camera: nearest_of(camera, MODELS[BROWN]))
            groups = "".join(
                _group(number, camera, of_camera[camera_id], solution, origin_m)
                for number, (camera_id, camera) in enumerate(cameras.items())
            )
            system = "" if crs == _LOCAL else "<SRSId>0</SRSId>"
            systems = "" if crs == _LOCAL else (
                "<SpatialReferenceSystems><SRS><Id>0</Id><Name>" + escape(crs) + "</Name><Definition>" + escape(crs)
                + "</Definition></SRS></SpatialReferenceSystems>\n"
            )  # fmt: skip
            ties = "".join(_ties(found, solution, keypoints, origin_m))
            write(
                partial / "blocks.xml",
                f'<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="3.2">\n{systems}<Block>'
                f"<Name>aeromatch</Name>{system}\n<Photogroups>\n{groups}</Photogroups>\n<TiePoints>\n{ties}"
                "</TiePoints>\n</Block>\n</BlocksExchange>\n",
            )
            count = sum(map(len, keypoints.values()))
            return summary_of(folder, partial, contents, len(solution.poses), count, found.counts, remarks)


def _group(
    number: int, camera: Camera, images: Sequence[tuple[int, Image]], solution: Solution, origin_m: FloatArray
) -> str:
    """images: of the camera, with their places among all."""
    values = parameters(camera)
    lens = "".join(
        f"<{tag}>{values[key]:.12g}</{tag}>"
        for tag, key in (("K1", "k1"), ("K2", "k2"), ("K3", "k3"), ("P1", "p2"), ("P2", "p1"))
    )
    photos = "".join(_photo(place, image, solution, origin_m) for place, image in images)
    return (
        f"<Photogroup><Name>{number}</Name><ImageDimensions><Width>{camera.width_px}</Width><Height>{camera.height_px}"
        "</Height></ImageDimensions><CameraModelType>Perspective</CameraModelType>"
        f"<FocalLengthPixels>{values['fx']:.9g}</FocalLengthPixels><AspectRatio>{values['fy'] / values['fx']:.12g}"
        f"</AspectRatio><Skew>{values['skew']:.12g}</Skew><PrincipalPoint><x>{values['cx']:.9g}</x><y>{values['cy']:.9g}</y></PrincipalPoint>"
        f"<Distortion>{lens}</Distortion><CameraOrientation>XRightYDown</CameraOrientation>\n{photos}</Photogroup>\n"
    )


def _photo(number: int, image: Image, solution: Solution, origin_m: FloatArray) -> str:
    pose = ""
    if image.image_id in solution.poses:
        rotation, center_m = solution.poses[image.image_id]
        cells = "".join(f"<M_{i}{j}>{rotation[i, j]:.15g}</M_{i}{j}>" for i in range(3) for j in range(3))
        place = "".join(f"<{key}>{value:.6f}</{key}>" for key, value in zip("xyz", center_m + origin_m, strict=True))
        pose = f"<Pose><Rotation>{cells}</Rotation><Center>{place}</Center></Pose>"
    return f"<Photo><Id>{number}</Id><ImagePath>{escape(image.name)}</ImagePath>{pose}</Photo>\n"


def _ties(found: Matched, solution: Solution, keypoints: Mapping[str, FloatArray], origin_m: FloatArray) -> list[str]:
    starts, lines = found.starts, []
    for number, point in enumerate(found.points_m):
        own = range(starts[number], starts[number + 1])
        if not own:
            continue
        seen = []
        for row in own:
            x, y = keypoints[solution.images[found.image_idx[row]].image_id][found.keypoint[row]]
            seen.append(
                f"<Measurement><PhotoId>{found.image_idx[row]}</PhotoId><x>{x:.4f}</x><y>{y:.4f}</y></Measurement>"
            )
        position = ""
        if np.isfinite(point).all():
            x, y, z = point + origin_m
            position = f"<Position><x>{x:.6f}</x><y>{y:.6f}</y><z>{z:.6f}</z></Position>"
        lines.append(f"<TiePoint>{position}{''.join(seen)}</TiePoint>\n")
    return lines
