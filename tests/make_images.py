"""Tiny image files with the headers that tests need."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2
from rasterio.errors import NotGeoreferencedWarning

_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825

DJI_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" '
    'drone-dji:RelativeAltitude="{relative}" drone-dji:AbsoluteAltitude="+198.31" drone-dji:FlightYawDegree="+11.00" '
    'drone-dji:FlightPitchDegree="+1.80" drone-dji:FlightRollDegree="+3.00" drone-dji:GimbalYawDegree="{yaw}" '
    'drone-dji:GimbalPitchDegree="{pitch}" drone-dji:GimbalRollDegree="{roll}"/></rdf:RDF></x:xmpmeta>'
)
PARROT_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description rdf:about="" xmlns:Camera="http://pix4d.com/camera/1.0/"><Camera:Yaw>{yaw}</Camera:Yaw>'
    "<Camera:Pitch>{pitch}</Camera:Pitch><Camera:Roll>{roll}</Camera:Roll></rdf:Description></rdf:RDF></x:xmpmeta>"
)


def sexagesimal(value_deg: float) -> tuple[float, float, float]:
    degrees = int(abs(value_deg))
    minutes = int((abs(value_deg) - degrees) * 60)
    return float(degrees), float(minutes), ((abs(value_deg) - degrees) * 60 - minutes) * 60


def gps_tags(latitude_deg: float, longitude_deg: float, altitude_m: float | None) -> dict[int, Any]:
    tags: dict[int, Any] = {
        1: "N" if latitude_deg >= 0 else "S",
        2: sexagesimal(latitude_deg),
        3: "E" if longitude_deg >= 0 else "W",
        4: sexagesimal(longitude_deg),
    }
    if altitude_m is not None:
        tags |= {5: b"\x00" if altitude_m >= 0 else b"\x01", 6: abs(altitude_m)}
    return tags


def write_image(
    path: Path,
    size_px: tuple[int, int] = (40, 30),
    *,
    main: dict[int, Any] | None = None,
    exif: dict[int, Any] | None = None,
    gps: dict[int, Any] | None = None,
    xmp: str = "",
) -> Path:
    """A gray picture with the given main, EXIF and GPS tags and XMP packet; .tif is 16 bit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    tags = Image.Exif()
    tags.update(main or {})
    tags.get_ifd(_EXIF_IFD).update(exif or {})
    tags.get_ifd(_GPS_IFD).update(gps or {})
    if path.suffix.lower() in (".tif", ".tiff"):
        tags[_EXIF_IFD], tags[_GPS_IFD] = 0, 0  # Pillow writes a table to TIFF only if its pointer is present
        if xmp:
            tags[700] = xmp.encode()
        Image.fromarray(np.full(size_px[::-1], 40000, dtype=np.uint16)).save(path, exif=tags)
    elif path.suffix.lower() == ".png":
        Image.new("L", size_px, 99).save(path, exif=tags)
    else:
        extra = {"xmp": xmp.encode()} if xmp else {}
        Image.new("RGB", size_px, (90, 120, 60)).save(path, format="JPEG", exif=tags, **extra)
    return path


def write_bands(
    path: Path,
    bands: NDArray[Any],
    *,
    main: dict[int, Any] | None = None,
    exif: dict[int, Any] | None = None,
    gps: dict[int, Any] | None = None,
    xmp: str = "",
    big: bool = False,
) -> Path:
    """A TIFF of bands (B, H, W), min-is-black as GDAL writes them, with tags as in `write_image`; big: BigTIFF."""
    count, height, width = bands.shape
    directory = ImageFileDirectory_v2(b"II+\0\x08\0\0\0\x10\0\0\0\0\0\0\0" if big else b"II*\0\x08\0\0\0")
    directory.update({256: width, 257: height, 258: (8 * bands.itemsize,) * count, 259: 1, 262: 1, 277: count})
    directory.update(
        {278: height, 279: bands.nbytes, 339: ({"u": 1, "i": 2, "f": 3, "c": 6}[bands.dtype.kind],) * count}
    )
    directory.update({273: 0} | (main or {}))  # where the pixels begin, behind the tables
    directory.tagtype[273] = directory.tagtype[279] = 16 if big else 4
    directory.update({pointer: table for pointer, table in ((_EXIF_IFD, exif), (_GPS_IFD, gps)) if table})
    if xmp:
        directory.tagtype[700], directory[700] = 1, xmp.encode()
    with path.open("wb") as stream:
        directory.save(stream)
        stream.write(np.ascontiguousarray(np.moveaxis(bands, 0, 2)).tobytes())
    return path


def write_jpeg_2000(path: Path, bands: NDArray[Any]) -> Path:
    """Lossless JPEG 2000 of bands (B, H, W) in tiles of 256 pixels."""
    count, height, width = bands.shape
    size: dict[str, Any] = {"count": count, "height": height, "width": width, "dtype": bands.dtype}
    lossless = {"QUALITY": 100, "REVERSIBLE": "YES", "BLOCKXSIZE": 256, "BLOCKYSIZE": 256}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="JP2OpenJPEG", **size, **lossless) as out:
            out.write(bands)
    path.with_name(path.name + ".aux.xml").unlink(missing_ok=True)
    return path


def write_dji(path: Path, latitude_deg: float, longitude_deg: float, altitude_m: float, **angles: float) -> Path:
    """A DJI picture, nadir and north-up unless angles say otherwise, 100 m above take-off."""
    values = {"yaw": 0.0, "pitch": -90.0, "roll": 0.0, "relative": 100.0} | angles
    return write_image(
        path,
        main={271: "DJI\0\0", 272: "FC6310"},
        exif={37386: 8.8, 41989: 24},
        gps=gps_tags(latitude_deg, longitude_deg, altitude_m),
        xmp=DJI_XMP.format(**values).replace("+198.31", f"{altitude_m:+.2f}"),
    )
