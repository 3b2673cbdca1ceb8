"""One camera in every format of pose files.

The numbers are two hand-worked cameras at E 500000, N 4649776.224819, h 400 of EPSG:32633 (42 N, 15 E, on the central
meridian, so that grid north is true north): A is nearly straight down with three different angles, which shows orders
and signs; B looks north-east, 45 degrees below the horizon, which shows zeros. R = Rx(omega) Ry(phi) Rz(kappa) F.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

E, N, H = 500000.0, 4649776.224819, 400.0
LATITUDE, LONGITUDE = 42.0, 15.0


@dataclass(frozen=True)
class Canonical:
    """world_from_cam (3, 3), OpenCV's axes; angles in degrees; quaternion and angle-axis of cam_from_world."""

    name: str
    world_from_cam: np.ndarray
    opk: tuple[float, ...]
    pok: tuple[float, ...]
    nadir: tuple[float, ...]
    quaternion: tuple[float, ...]
    axis: tuple[float, ...]

    @property
    def translation(self) -> np.ndarray:
        """t of x = R'(X - C) for C = (0, 0, 400)."""
        return -self.world_from_cam.T @ [0.0, 0.0, H]


A = Canonical(
    "A.jpg",
    np.array(
        [
            [0.862729915935, 0.498097349046, 0.087155742748],
            [0.479297070614, -0.860435750083, 0.172987393925],
            [0.161156478973, -0.107467907602, -0.981060262190],
        ]
    ),
    (10.0, -5.0, 30.0),
    (-5.076733017, 9.961558098, 29.119552984),
    (-30.066105871, 6.169372004, -9.328532710),
    (0.072859288, 0.962318285, 0.253916619, 0.064508860),
    (2.890542438, 0.762696472, 0.193767073),
)
B = Canonical(
    "B.jpg",
    np.array([[0.5**0.5, -0.5, 0.5], [-(0.5**0.5), -0.5, 0.5], [0.0, -(0.5**0.5), -(0.5**0.5)]]),
    (35.264389683, -30.0, -35.264389683),
    (-35.264389683, 30.0, -54.735610317),
    (45.0, 45.0, 0.0),
    (0.353553391, 0.853553391, -0.353553391, 0.146446609),
    (2.207176746, -0.914242543, 0.378691660),
)
FLIP = np.diag([1.0, -1.0, -1.0])


def texts(values, digits: int = 9) -> str:
    return " ".join(f"{value:.{digits}f}" for value in np.asarray(values).ravel())


def commas(values) -> str:
    return texts(values).replace(" ", ",")


def geocentric() -> np.ndarray:
    """Of 42 N, 15 E, 400 m: closed formulas of the WGS84 ellipsoid."""
    a, f = 6378137.0, 1 / 298.257223563
    latitude, longitude = np.deg2rad([LATITUDE, LONGITUDE])
    e2 = f * (2 - f)
    n = a / np.sqrt(1 - e2 * np.sin(latitude) ** 2)
    flat = (n + H) * np.cos(latitude)
    return np.array([flat * np.cos(longitude), flat * np.sin(longitude), (n * (1 - e2) + H) * np.sin(latitude)])


def enu() -> np.ndarray:
    """Columns: east, north and up in geocentric axes."""
    latitude, longitude = np.deg2rad([LATITUDE, LONGITUDE])
    (sf, sl), (cf, cl) = np.sin([latitude, longitude]), np.cos([latitude, longitude])
    return np.array([[-sl, cl, 0.0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]]).T


def wkt(code: str) -> str:
    from pyproj import CRS

    return CRS.from_user_input(code).to_wkt("WKT1_GDAL")


def lines(*rows: str) -> str:
    return "\n".join(rows) + "\n"


def each(row) -> list[str]:
    return [row(camera) for camera in (A, B)]


def _blocks_exchange(rotation, orientation: str) -> str:
    photos = "".join(
        f"<Photo><Id>{k}</Id><ImagePath>D:\\flight\\{c.name}</ImagePath><Pose><Rotation>{rotation(c)}</Rotation>"
        f"<Center><x>{E}</x><y>{N}</y><z>{H}</z></Center></Pose></Photo>"
        for k, c in enumerate((A, B))
    )
    axes = f"<CameraOrientation>{orientation}</CameraOrientation>" if orientation else ""
    return (
        "<BlocksExchange version='3.2'><SpatialReferenceSystems><SRS><Id>0</Id><Definition>EPSG:32633</Definition>"
        f"</SRS></SpatialReferenceSystems><Block><SRSId>0</SRSId><Photogroups><Photogroup>{axes}{photos}</Photogroup>"
        "</Photogroups></Block></BlocksExchange>"
    )


def _matrix_cells(matrix) -> str:
    return "".join(f"<M_{i}{j}>{matrix[i, j]:.12f}</M_{i}{j}>" for i in range(3) for j in range(3))


def _angle_cells(omega: float, phi: float, kappa: float) -> str:
    return f"<Omega>{omega:.9f}</Omega><Phi>{phi:.9f}</Phi><Kappa>{kappa:.9f}</Kappa>"


def _metashape_xml() -> str:
    """A chunk in a frame of its own, turned, shifted and scaled into geocentric coordinates."""
    turn = enu() @ np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    scale, shift = 20.0, geocentric() - 20.0 * turn @ [1.0, 2.0, 3.0]

    def camera(k: int, c: Canonical) -> str:
        matrix = np.eye(4)
        matrix[:3, :3] = turn.T @ enu() @ c.world_from_cam
        matrix[:3, 3] = 1.0, 2.0, 3.0
        return f"<camera id='{k}' sensor_id='0' label='{c.name[0]}'><transform>{texts(matrix, 15)}</transform></camera>"

    return (
        "<?xml version='1.0' encoding='UTF-8'?><document version='2.0.0'><chunk><sensors><sensor id='0'>"
        "<resolution width='4000' height='3000'/><calibration type='frame' class='adjusted'>"
        "<resolution width='4000' height='3000'/><f>3000</f><cx>10</cx><cy>-5</cy><k1>-0.01</k1></calibration></sensor>"
        f"</sensors><cameras>{camera(0, A)}{camera(1, B)}<camera id='2' sensor_id='0' label='C'/></cameras>"
        f"<transform><rotation>{texts(turn, 15)}</rotation><translation>{texts(shift, 6)}</translation>"
        f"<scale>{scale}</scale></transform></chunk></document>"
    )


def _colmap_binary() -> bytes:
    raw = struct.pack("<Q", 2)
    for k, c in enumerate((A, B), 1):
        raw += struct.pack("<i7di", k, *c.quaternion, *c.translation, 1) + c.name.encode() + b"\0"
        raw += struct.pack("<Q", 1) + struct.pack("<ddQ", 1.0, 2.0, 2**64 - 1)
    return raw


def _opensfm() -> str:
    shots = {
        c.name: {"rotation": c.axis, "translation": c.translation.tolist(), "camera": "v2 x 4000 3000 brown 0.75"}
        for c in (A, B)
    }
    cameras = {
        "v2 x 4000 3000 brown 0.75": {
            "projection_type": "brown", "width": 4000, "height": 3000, "focal_x": 0.75, "focal_y": 0.75, "c_x": 0.0025,
            "c_y": -0.00125, "k1": -0.01, "k2": 0.0, "k3": 0.0, "p1": 0.0, "p2": 0.0,
        }
    }  # fmt: skip
    reference = {"latitude": LATITUDE, "longitude": LONGITUDE, "altitude": 0.0}
    return json.dumps([{"cameras": cameras, "shots": shots, "points": {}, "reference_lla": reference}])


def _transforms() -> str:
    frames = []
    for c in (A, B):
        matrix = np.eye(4)
        matrix[:3, :3] = c.world_from_cam @ FLIP
        matrix[:3, 3] = 0.0, 0.0, H
        # As nerfstudio stores it: world axes exchanged and scaled.
        applied = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 5.0]])
        whole = applied[:, :3] @ matrix[:3]
        whole[:, 3] += applied[:, 3]
        whole[:, 3] *= 0.01
        frames.append({"file_path": f"./images/{c.name}", "transform_matrix": [*whole.tolist(), [0, 0, 0, 1]]})
    lens = {"w": 4000, "h": 3000, "fl_x": 3000.0, "cx": 2010.0, "cy": 1495.0, "k1": -0.01}
    return json.dumps({**lens, "applied_transform": applied.tolist(), "applied_scale": 0.01, "frames": frames})


def _shots() -> str:
    return json.dumps(
        {
            "type": "FeatureCollection",
            "features": [
                {
                    "geometry": {"type": "Point", "coordinates": [LONGITUDE, LATITUDE, H]},
                    "properties": {"filename": c.name, "rotation": c.axis, "translation": [E, N, H]},
                }
                for c in (A, B)
            ],
        }
    )


def _micmac(c: Canonical) -> str:
    rows = "".join(f"<L{k}>{texts(row, 12)}</L{k}>" for k, row in enumerate(c.world_from_cam, 1))
    return (
        f"<ExportAPERO><OrientationConique><Externe><Centre>{E} {N} {H}</Centre><ParamRotation><CodageMatr>{rows}"
        "</CodageMatr></ParamRotation></Externe><ConvOri><KnownConv>eConvApero_DistM2C</KnownConv></ConvOri>"
        "</OrientationConique></ExportAPERO>"
    )


def _inpho() -> str:
    photos = each(
        lambda c: lines(
            "$PHOTO", f"  $PHOTO_NUM : {c.name[0]}", f'  $PHOTO_FILE : "D:\\flight\\{c.name}"', "  $CAMERA_ID : cam",
            "  $EXT_ORI : 10:00:00 01/01/2020", f"  30.0 {E} {N} {H}",
            *(f"  {texts(row, 12)}" for row in (c.world_from_cam @ FLIP).T), "$END",
        )
    )  # fmt: skip
    return "$PROJECT\n$END\n" + "".join(photos)


def _pix4d_cameras() -> str:
    body = [
        lines(
            f"{c.name} 4000 3000", "3000 0 2000", "0 3000 1500", "0 0 1", "0 0 0", "0 0",
            "0.000000 76.224819 400.000000", *(texts(row, 12) for row in c.world_from_cam.T),
        )
        for c in (A, B)
    ]  # fmt: skip
    head = (
        "fileName imageWidth imageHeight\ncamera matrix K [3x3]\nradial distortion [3x1]\ntangential distortion [2x1]\n"
    )
    return head + "camera position t [3x1]\ncamera rotation R [3x3]\ncamera model m = K [R|-Rt] X\n\n" + "".join(body)


PLACE = f"{E} {N} {H}"
HEADER = "#Label,X/Easting,Y/Northing,Z/Altitude,"
# File name -> content, of formats that state the grid's or geographic coordinates.
WORLD: dict[str, str | bytes] = {
    "odm/geo.txt": lines(
        "EPSG:32633", "# a comment", *each(lambda c: f"{c.name} {PLACE} {texts(c.nadir)} 0.03 0.05")
    ),
    "odm-utm/geo.txt": lines("WGS84 UTM 33N", *each(lambda c: f"{c.name} {PLACE} {texts(c.nadir)}")),
    "odm-degrees/geo.txt": lines(
        "EPSG:4326", *each(lambda c: f"{c.name} {LONGITUDE} {LATITUDE} {H} {texts(c.nadir)}")
    ),
    "odm-shots/shots.geojson": _shots(),
    "opensfm/reconstruction.json": _opensfm(),
    "opensfm-exif/exif_overrides.json": json.dumps(
        {
            c.name: {
                "gps": {"latitude": LATITUDE, "longitude": LONGITUDE, "altitude": H, "dop": 0.05},
                "opk": dict(zip(("omega", "phi", "kappa"), c.opk, strict=True)),
            }
            for c in (A, B)
        }
    ),
    "metashape/ypr.txt": lines(
        f"# CoordinateSystem: {wkt('EPSG:32633')}",
        HEADER + "Yaw,Pitch,Roll,Accuracy_X_(m),Accuracy_Y_(m),Accuracy_Z_(m)",
        *each(lambda c: f"{c.name},{E},{N},{H},{commas(c.nadir)},0.03,0.03,0.05"), "# the end",
    ),
    "metashape-opk/opk.csv": lines(
        f"# CoordinateSystem: {wkt('EPSG:32633')}", HEADER + "Omega,Phi,Kappa",
        *each(lambda c: f"{c.name[0]},{E},{N},{H},{texts(c.opk).replace(' ', ',')}"),
    ),
    "metashape-pok/pok.csv": lines(
        f"# CoordinateSystem: {wkt('EPSG:32633')}", (HEADER + "Phi,Omega,Kappa").replace(",", "\t"),
        *each(lambda c: f"{c.name}\t{E}\t{N}\t{H}\t" + texts(c.pok).replace(" ", "\t").replace(".", ",")),
    ),
    "metashape-estimated/est.csv": lines(
        f"# CoordinateSystem: {wkt('EPSG:4326')}",
        "#Label,Enable,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll,X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est",
        *each(lambda c: f"{c.name},1,14.9,41.9,380,1,2,3,{LONGITUDE},{LATITUDE},{H},{commas(c.nadir)}"),
    ),
    "metashape-xml/cameras.xml": _metashape_xml(),
    "blocks-exchange/matrix.xml": _blocks_exchange(lambda c: _matrix_cells(c.world_from_cam.T), ""),
    "blocks-exchange-up/angles.xml": _blocks_exchange(lambda c: _angle_cells(*c.opk), "XRightYUp"),
    "blocks-exchange-down/angles.xml": _blocks_exchange(
        lambda c: _angle_cells(c.opk[0] - 180.0, -c.opk[1], -c.opk[2]), "XRightYDown"
    ),
    "pix4d-external/x_calibrated_external_camera_parameters.txt": lines(
        "imageName X Y Z Omega Phi Kappa", *each(lambda c: f"{c.name} {PLACE} {texts(c.opk)}")
    ),
    "pix4d-ypr/geolocation.csv": lines(
        *each(lambda c: f"{c.name},{LATITUDE},{LONGITUDE},{H},{texts(c.nadir).replace(' ', ',')},0.03,0.05")
    ),
    "pix4d-opk/geolocation.csv": lines(*each(lambda c: f"{c.name},{E},{N},{H},{texts(c.opk).replace(' ', ',')}")),
    "pix4d-cameras/x_calibrated_camera_parameters.txt": _pix4d_cameras(),
    "inpho/block.prj": _inpho(),
    "micmac-txt/ori.txt": lines("#F=N X Y Z W P K", "#", *each(lambda c: f"{c.name} {PLACE} {texts(c.opk)}")),
    "bingo/itera.dat": lines(
        "ORIA " + f"{A.name} {PLACE} {texts(np.array(A.opk) / 0.9)}", "C a comment",
        "ORIA " + f"{B.name} {PLACE} {texts(np.array(B.opk) / 0.9)}",
    ),
    "geojson/layer.geojson": json.dumps(
        {
            "type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32633"}},
            "features": [
                {
                    "type": "Feature", "geometry": {"type": "Point", "coordinates": [E, N, H]},
                    "properties": dict(zip(("filename", "omega", "phi", "kappa"), (c.name, *c.opk), strict=True)),
                }
                for c in (A, B)
            ],
        }
    ),
    "mission-planner/location.txt": lines(
        "#name latitude/Y longitude/X height/Z yaw pitch roll SAlt",
        *each(lambda c: f"{c.name} {LATITUDE} {LONGITUDE} {H} {texts(c.nadir)} 100.5"),
    ),
    "opk/table.txt": lines(*each(lambda c: f"{c.name} {PLACE} {texts(c.opk)}")),
    "opk-gon/table.txt": lines(*each(lambda c: f"{c.name} {PLACE} {texts(np.array(c.opk) / 0.9)}")),
    "pok/table.txt": lines(*each(lambda c: f"{c.name} {PLACE} {texts(c.pok)}")),
    "pok-gon/table.txt": lines(*each(lambda c: f"{c.name} {PLACE} {texts(np.array(c.pok) / 0.9)}")),
}  # fmt: skip
# Of frames without a CRS: the centre is (0, 0, 400).
LOCAL: dict[str, str | bytes] = {
    "colmap/images.txt": lines(
        "# Image list", *each(lambda c: f"1 {texts(c.quaternion)} {texts(c.translation)} 1 {c.name}\n")
    ),
    "colmap-points/images.txt": lines(
        *each(lambda c: f"1 {texts(c.quaternion)} {texts(c.translation)} 1 {c.name}\n1.5 2.5 -1 3.5 4.5 7")
    ),
    "colmap-binary/images.bin": _colmap_binary(),
    "bundler/bundle.out": lines(
        "# Bundle file v0.3", "3 0",
        *each(lambda c: lines("3000 0 0", *map(texts, FLIP @ c.world_from_cam.T)) + texts(FLIP @ c.translation)),
        "0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0",
    ),
    "nvm/model.nvm": lines(
        "NVM_V3", "", "2", *each(lambda c: f"{c.name}\t3000 {texts(c.quaternion)} 0 0 400 0 0"), "", "0"
    ),
    "transforms/transforms.json": _transforms(),
}  # fmt: skip


def write(folder: Path, name: str, content: str | bytes) -> Path:
    """One of the files above, with what belongs beside it; the path for --poses."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode("utf-8"))
    if name.startswith("bundler/"):
        (path.parent / "list.txt").write_text("A.jpg 0 3000\nB.jpg 0 3000\nC.jpg\n")
    if name.startswith("pix4d-cameras/"):
        (path.parent / "x_offset.xyz").write_text("500000.000 4649700.000 0.000\n")
    return path


def write_micmac(folder: Path) -> Path:
    """The folder of MicMac's orientations."""
    target = folder / "Ori-Block"
    target.mkdir()
    for c in (A, B):
        (target / f"Orientation-{c.name}.xml").write_text(_micmac(c))
    return target


def patb(*, transposed: bool) -> str:
    """A strip of three photos along kappa = 30 degrees."""
    step = np.array([np.cos(np.deg2rad(30.0)), np.sin(np.deg2rad(30.0)), 0.0])
    out = []
    for k in range(3):
        matrix = A.world_from_cam @ FLIP
        matrix = matrix.T if transposed else matrix
        cells = [f"{v:16.12f}" for v in matrix.ravel()]
        center = np.array([E, N, H]) + 60.0 * k * step
        out += [f"{k + 1:16d}" + "".join(f"{v:16.5f}" for v in center), "".join(cells[:5]), "".join(cells[5:])]
    return lines(*out)


def written(folder: Path, text: str | bytes, name: str = "list.csv") -> Path:
    """A list as it is given, its line ends included."""
    return write(folder, name, text)
