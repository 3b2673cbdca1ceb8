"""Every format of poses by name: how it is recognised and read."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from aeromatch_cli.blocks.crs import AUTO as AUTO_CRS
from aeromatch_cli.blocks.crs import LOCAL
from aeromatch_cli.blocks.fields import IMAGE, fields_of
from aeromatch_cli.blocks.pose_columns import has_header, is_track
from aeromatch_cli.blocks.pose_files import (
    blocks_exchange,
    colmap,
    dji,
    exiftool,
    geojson,
    metashape,
    micmac,
    odm,
    opensfm,
    pix4d,
    preambles,
    scenes,
    tables,
)
from aeromatch_cli.blocks.pose_files.geodesy import StatedCrs, described_crs, like_utm
from aeromatch_cli.blocks.pose_files.source import Source, is_number, units_of_comments, world_beside
from aeromatch_cli.blocks.poses import PoseList, read_poses
from aeromatch_cli.blocks.statements import statements_of
from aeromatch_cli.errors import ConfigError

AUTO = "auto"


@dataclass(frozen=True)
class PoseFormat:
    """title: in words. read: raises ConfigError with file, line and column. recognises: None where only its name asks
    for it. plain: comments of a list, or a .prj beside it, may name its CRS."""

    title: str
    read: Callable[[Source], PoseList]
    recognises: Callable[[Source], bool] | None = None
    plain: bool = False


def _named_columns(source: Source) -> PoseList:
    """orientation.csv of this program counts in the CRS that its neighbours name."""
    found = read_poses(source.path)
    if found.crs is not None:
        return _in_stated_crs(source, found, found.crs, str(source.path))
    crs, _ = world_beside(source)
    own = source.name == "orientation.csv" and found.position_kind == "grid" and crs is not None
    return replace(found, crs=crs, format="orientation.csv of aeromatch") if own else _as_plain(source, found)


def _as_plain(source: Source, found: PoseList) -> PoseList:
    """Of a list whose lines do not name the CRS: by its comments, else by a .prj beside it."""
    comment = statements_of(source.lines).crs_of(grid=found.position_kind == "grid")
    text, where = (comment, str(source.path)) if comment else source.crs_beside()
    return _in_stated_crs(source, found, text, where) if text else found


def _in_stated_crs(source: Source, found: PoseList, text: str, where: str) -> PoseList:
    """Of a list whose CRS is stated by a text."""
    stated = described_crs(where, text)
    if found.position_kind == "geographic" and stated.kind == "grid":  # the world's
        return replace(found, crs=stated.crs, heights=stated.heights or found.heights)
    grid = found.position_kind == "grid"
    if grid:  # what columns state counts before the unit of the CRS
        found = _in_units(source, found, (stated.across_m, stated.up_m))
    one = replace(stated, across_m=1.0, up_m=1.0)
    rows = []
    for row in found.rows:
        if row.position is not None:
            x, y, height_m = row.position
            across = (x, y) if grid else (y, x)
            row = replace(row, position=one.position(source.at(row.line), *across, height_m), position_kind=one.kind)
        rows.append(row)
    said = like_utm(stated, [row.position[:2] for row in found.rows if row.position is not None and grid])
    words, warnings = f"{found.format}, {stated.name}", (*stated.remarks, *said, *found.warnings)
    heights = stated.heights or found.heights
    return replace(
        found, rows=tuple(rows), position_kind=one.kind, crs=one.crs, warnings=warnings, format=words, heights=heights
    )


def _in_units(source: Source, found: PoseList, usual_m: tuple[float, float]) -> PoseList:
    """In metres, of a list without units of its own. usual_m: metres of one unit of x and y, and of heights; what
    columns and comments state counts before them."""
    if found.format == PoseList.format:
        return read_poses(source.path, usual_m)
    said = units_of_comments(source)
    across_m, up_m = 1.0 if said.across_m else usual_m[0], 1.0 if said.up_m else usual_m[1]
    rows = []
    for row in found.rows:
        x, y, z = row.position or (0.0, 0.0, 0.0)
        place = None if row.position is None else (x * across_m, y * across_m, z * up_m)
        rows.append(replace(row, position=place))
    return replace(found, rows=tuple(rows))


_MISSION_PLANNER = re.compile(r"#\s*name\s+latitude/y\s+longitude/x\b.*", re.IGNORECASE)


def _is_mission_planner(source: Source) -> bool:
    return any(_MISSION_PLANNER.match(line.strip()) for line in source.lines[:5])


def _mission_planner(source: Source) -> PoseList:
    """Angles are the aircraft's, below which the camera looks down; SAlt is the height above ground."""
    found = read_poses(source.path)
    rows = tuple(replace(row, forward=False) for row in found.rows)
    return replace(found, rows=rows, format="Mission Planner location.txt")


# In the order in which they are tried: those that nothing else looks like first.
POSE_FORMATS: Mapping[str, PoseFormat] = {
    "colmap": PoseFormat("COLMAP images.txt, images.bin or their folder", colmap.read_model, colmap.is_model),
    "micmac": PoseFormat("MicMac folder Ori-* or Orientation-*.xml", micmac.read_ori, micmac.is_ori),
    "micmac-txt": PoseFormat("MicMac text for OriConvert", micmac.read_ori_txt, micmac.is_ori_txt),
    "blocks-exchange": PoseFormat(
        "BlocksExchange XML (Bentley, Metashape)", blocks_exchange.read_blocks_exchange,
        blocks_exchange.is_blocks_exchange,
    ),
    "metashape-xml": PoseFormat("Metashape cameras.xml", metashape.read_cameras_xml, metashape.is_cameras_xml),
    "metashape": PoseFormat(
        "Metashape reference, estimated poses before given ones", metashape.read_reference, metashape.is_reference
    ),
    "metashape-given": PoseFormat(
        "Metashape reference, given poses", partial(metashape.read_reference, estimated=False)
    ),
    "opensfm": PoseFormat("OpenSfM reconstruction.json", opensfm.read_reconstruction, opensfm.is_reconstruction),
    "odm-shots": PoseFormat("ODM and WebODM shots.geojson", odm.read_shots, odm.is_shots),
    "geojson": PoseFormat("GeoJSON of points", geojson.read_points, geojson.is_points),
    "transforms": PoseFormat("NeRF transforms.json", scenes.read_transforms, scenes.is_transforms),
    "opensfm-exif": PoseFormat("OpenSfM exif_overrides.json", opensfm.read_overrides, opensfm.is_overrides),
    "exiftool": PoseFormat("ExifTool -csv or -json", exiftool.read_exiftool, exiftool.is_exiftool),
    "odm": PoseFormat("ODM geo.txt", odm.read_geo_txt, odm.is_geo_txt),
    "dji-mrk": PoseFormat("DJI *_Timestamp.MRK", dji.read_mrk, dji.is_mrk),
    "mission-planner": PoseFormat("Mission Planner location.txt", _mission_planner, _is_mission_planner),
    "bingo": PoseFormat("BINGO's records ORIA", tables.read_oria, tables.is_oria, plain=True),
    "bundler": PoseFormat("Bundler .out with list.txt", scenes.read_bundler, scenes.is_bundler),
    "nvm": PoseFormat("VisualSFM .nvm", scenes.read_nvm, scenes.is_nvm),
    "inpho": PoseFormat("Inpho project .prj", tables.read_inpho, tables.is_inpho),
    "pix4d-cameras": PoseFormat(
        "Pix4D *_calibrated_camera_parameters.txt", pix4d.read_camera_parameters, pix4d.is_camera_parameters
    ),
    "report": PoseFormat(
        "report with text above the names of its columns (POSPac)", preambles.read_report, preambles.is_report
    ),
    "patb": PoseFormat("PATB orientations", tables.read_patb, tables.is_patb),
    "pix4d": PoseFormat("Pix4D geolocation without header", pix4d.read_geolocation, pix4d.is_geolocation, plain=True),
    "pix4d-opk": PoseFormat("the same with omega, phi, kappa", pix4d.read_as_opk, plain=True),
    "pix4d-ypr": PoseFormat("the same with yaw, pitch, roll", pix4d.read_as_ypr, plain=True),
    "table": PoseFormat(
        "name x y z and three angles without header (BINGO, ORIMA, OriExport)", tables.read_plain_table,
        tables.is_plain_table, plain=True,
    ),
    "opk": PoseFormat("the same with omega, phi, kappa in degrees", tables.read_opk, plain=True),
    "opk-gon": PoseFormat("the same in gon", tables.read_opk_gon, plain=True),
    "pok": PoseFormat("the same with phi, omega, kappa in degrees", tables.read_pok, plain=True),
    "pok-gon": PoseFormat("the same in gon", tables.read_pok_gon, plain=True),
    "columns": PoseFormat("list whose first line names the columns", _named_columns),
}  # fmt: skip

# What other programs write that holds no poses to read, by the end of its name: what it is and what to do.
_OTHERS: Mapping[str, str] = {
    ".psx": "a Metashape project: export its reference (CSV) or cameras (XML)",
    ".psz": "a Metashape project: export its reference (CSV) or cameras (XML)",
    ".p4d": "a Pix4D project: give *_calibrated_external_camera_parameters.txt of its folder 1_initial/params",
    ".opf": "a Pix4D project (OPF): export the calibrated external camera parameters as text",
    ".pos": "an RTKLIB solution, antenna positions by time: export the position of every image as CSV",
    ".obs": "raw GNSS observations: process them, and export the position of every image as CSV",
    ".bin": "binary, and not COLMAP's images.bin",
    ".sbet": "an SBET trajectory: export the orientation of every exposure as text",
    ".out": "no Bundler file, which begins with `# Bundle file`",
    ".xlsx": "an Excel workbook: save the sheet as CSV",
    ".xls": "an Excel workbook: save the sheet as CSV",
    ".ods": "a spreadsheet: save it as CSV",
    ".kml": "KML: export the positions as CSV",
    ".kmz": "KML: export the positions as CSV",
    ".gpx": "a GPX track: export the position of every image as CSV",
    ".shp": "a shapefile: export its table as CSV",
    ".gpkg": "a GeoPackage: export its table as CSV",
    ".db": "a database: export a COLMAP model from it (images.txt)",
    ".zip": "an archive: unpack it and give the pose file in it",
    "pmatrix.txt": "Pix4D's projection matrices: give *_calibrated_external_camera_parameters.txt beside it",
    "cameras.txt": "COLMAP's cameras, which is for --cameras: images.txt beside it has the poses",
    "cameras.json": "OpenSfM's camera models: reconstruction.json has the poses",
    "reference_lla.json": "the reference of an OpenSfM block: reconstruction.json has the poses",
    "gcp_list.txt": "ground control points, which are for --gcp",
}


def read_pose_file(path: Path, pose_format: str = AUTO, crs: str = AUTO_CRS) -> PoseList:
    """Poses of any format. pose_format: a key of POSE_FORMATS, or "auto" to go by the content. crs: what the user says
    that grid coordinates count in, whose units are those of a file that states none.

    Raises ConfigError where the file cannot be read, is of no known format, or is malformed.
    """
    source = Source(path)
    found = _read(source, pose_format)
    stated = _in_other_units(crs) if found.crs is None and found.position_kind == "grid" else None
    if stated is None:
        return found
    found = _in_units(source, found, (stated.across_m, stated.up_m))
    return replace(found, warnings=(*stated.remarks, *found.warnings))


def _read(source: Source, pose_format: str) -> PoseList:
    path = source.path
    if pose_format != AUTO:
        if pose_format not in POSE_FORMATS:
            raise ConfigError(f"pose format {pose_format!r} is unknown: use one of auto, {', '.join(POSE_FORMATS)}")
        return _checked(source, POSE_FORMATS[pose_format])
    if source.path.suffix.lower() not in (".zip", ".xlsx") and (source.is_folder or source.raw):
        for known in POSE_FORMATS.values():
            if known.recognises is not None and known.recognises(source):
                return _checked(source, known)
    if source.is_folder:
        raise ConfigError(f"pose list {path} is a folder: give a file, a COLMAP model or MicMac's Ori-* folder")
    other = next((words for end, words in _OTHERS.items() if source.name.endswith(end)), "")
    if other:
        raise ConfigError(f"pose list {path} looks like {other}")
    if words := _by_content(source):
        raise ConfigError(f"pose list {path} looks like {words}")
    if source.tree is not None or source.xml is not None:
        kind = "JSON" if source.tree is not None else "XML"
        raise ConfigError(
            f"pose list {path} is {kind} of a kind that is not read: docs/input.md lists those that are; a CSV whose "
            "first line names the columns always is"
        )
    if source.text.lstrip().startswith("<"):
        source.xml_root()
    return _named_columns(source)


def _in_other_units(crs: str) -> StatedCrs | None:
    """A projected CRS that counts in another unit than metres, None for any other text."""
    if crs.strip().lower() in ("", AUTO_CRS, LOCAL):
        return None
    stated = described_crs("--crs", crs)
    return stated if stated.kind == "grid" and (stated.across_m, stated.up_m) != (1.0, 1.0) else None


def _by_content(source: Source) -> str:
    """What a file of no known format is, and what to do; "" where nothing tells."""
    tree = source.tree
    if isinstance(tree, dict):
        if "sfm_data_version" in tree:
            return "openMVG's sfm_data: give its COLMAP model (openMVG_main_openMVG2Colmap)"
        if {"views", "intrinsics"} <= tree.keys():
            return "AliceVision's or Meshroom's cameras: give the COLMAP model that its node ExportColmap writes"
        if tree.get("type") == "FeatureCollection":
            return "GeoJSON: export its table as CSV with the image names and the coordinates"
    record = next((line for _, line in source.records()), "")
    cells = fields_of(record)[0] or [""]
    if cells[0].lower() == "track" or (len(cells) == 1 and cells[0].startswith("OPENSFM_TRACKS_VERSION")):
        return "a list of tracks, which are tie points: give the poses of the images"
    if has_header(source.lines):
        return ""
    if is_track(source.lines):
        return (
            "a flight log or a track, positions by time without image names: give the positions of the images (exif, "
            "or a list that a geotagging tool writes)"
        )
    if len(cells) in (3, 4, 5, 6, 7, 9) and IMAGE.fullmatch(cells[0]) and all(map(is_number, cells[1:])):
        return "ODM's geo.txt without its first line, which names the CRS, such as EPSG:32633 or EPSG:4326: add it"
    return ""


def _checked(source: Source, known: PoseFormat) -> PoseList:
    """What a format reads. Raises ConfigError for an empty list and for two lines with one name."""
    found = known.read(source)
    found = _as_plain(source, found) if known.plain and found.crs is None else found
    if not found.rows:
        raise ConfigError(f"{source.path}: no image in this {found.format}")
    lines: dict[str, int] = {}
    for row in found.rows:
        if row.image in lines:
            raise ConfigError(
                f"{source.path}, line {row.line}, column image: {row.image!r} stands in line {lines[row.image]} "
                "already: keep one of the two lines, or write the paths relative to the images folder"
            )
        lines[row.image] = row.line
    return found
